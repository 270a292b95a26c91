"""The safety filters that one system implements, as three independent choices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DisturbanceHandling = Literal["ignored", "worst_case", "estimated"]
Feasibility = Literal["none", "volume", "decay", "backup"]
ObserverKind = Literal["rise", "linear"]


@dataclass(frozen=True)
class Method:
    """What a safety filter does about the disturbance and about its own feasibility.

    Attributes:
        disturbance: Every row either ignores the disturbance, takes its worst case
            within ``|d| <= delta1``, or uses the observer's estimate and error bound.
        feasibility: What keeps the rows from leaving no input: nothing, the volume
            barrier's row in the QP, decay rates that are variables of it, or rows along
            the way of a backup law in place of the barriers' own.
        observer: The kind of observer; a method that does not estimate only logs it.
        source: Where the method comes from.
    """

    disturbance: DisturbanceHandling
    feasibility: Feasibility
    observer: ObserverKind
    source: str

    @property
    def has_volume_row(self) -> bool:
        """Whether the volume barrier's row is in the QP."""
        return self.feasibility == "volume"


METHODS: dict[str, Method] = {
    "cbf-qp": Method("ignored", "none", "rise", "Tan et al. 2021 (E6)"),
    "robust-cbf-qp": Method("worst_case", "none", "rise", "Emam et al. 2019 (B2)"),
    "wang-xu-dob-cbf-qp": Method("estimated", "none", "linear", "Wang & Xu 2023 (B4)"),
    "vcbf-qp": Method("ignored", "volume", "rise", "Parwana et al. 2023 (E52)"),
    "dob-cbf-qp": Method("estimated", "none", "rise", "the paper (E47)"),
    "dob-vcbf-qp": Method("estimated", "volume", "rise", "the paper (E54)"),
    "optimal-decay": Method("estimated", "decay", "rise", "Zeng et al. 2021 (E69)"),
    "backup": Method("estimated", "backup", "rise", "Chen et al. 2021 (E68)"),
}
