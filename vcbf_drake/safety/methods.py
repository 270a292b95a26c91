"""The six safety filters that one system implements, as three independent choices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DisturbanceHandling = Literal["ignored", "worst_case", "estimated"]
ObserverKind = Literal["rise", "linear"]


@dataclass(frozen=True)
class Method:
    """What a safety filter does about the disturbance and about its own feasibility.

    Attributes:
        disturbance: Every row either ignores the disturbance, takes its worst case
            within ``|d| <= delta1``, or uses the observer's estimate and error bound.
        volume: Whether the volume barrier's row is in the QP.
        observer: The kind of observer; a method that does not estimate only logs it.
        source: Where the method comes from.
    """

    disturbance: DisturbanceHandling
    volume: bool
    observer: ObserverKind
    source: str


METHODS: dict[str, Method] = {
    "cbf-qp": Method("ignored", False, "rise", "Tan et al. 2021 (E6)"),
    "robust-cbf-qp": Method("worst_case", False, "rise", "Emam et al. 2019 (B2)"),
    "wang-xu-dob-cbf-qp": Method("estimated", False, "linear", "Wang & Xu 2023 (B4)"),
    "vcbf-qp": Method("ignored", True, "rise", "Parwana et al. 2023 (E22)"),
    "dob-cbf-qp": Method("estimated", False, "rise", "the paper (E19)"),
    "dob-vcbf-qp": Method("estimated", True, "rise", "the paper (E24)"),
}
