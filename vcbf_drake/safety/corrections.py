"""Corrections: which errata of the published method a filter applies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vcbf_drake.typed import check_fields

Fidelity = Literal["corrected", "paper"]


@dataclass
class Corrections:
    """The errata of the published method, each on or off.

    Attributes:
        exact_slack: The volume row gives way only where it must (E55); off, it has the
            printed penalty M delta^2 (E54, the DOB-VCBF-QP).
        total_derivative: The volume row counts that the estimate moves (E62); off, it
            is the printed derivative (E53, the printed volume term).
        error_floor: The error bound is the certified one of sampled time (E28), with
            the margin of the hold; off, it is the printed one (E20), which tends to 0.
    """

    exact_slack: bool = False
    total_derivative: bool = False
    error_floor: bool = False

    def __post_init__(self) -> None:
        check_fields(self)


FIDELITIES: dict[Fidelity, Corrections] = {
    "corrected": Corrections(True, True, True),
    "paper": Corrections(),
}
