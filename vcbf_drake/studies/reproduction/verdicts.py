"""The verdict table: every claim of the paper against what was measured."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vcbf_drake.studies.reproduction.judgements import (
    car,
    figure_1,
    figure_2,
    table_1,
)
from vcbf_drake.studies.reproduction.judgements.finding import Data, Finding
from vcbf_drake.studies.trial import Record


class Claim(NamedTuple):
    """A claim of the paper and who judges it.

    Attributes:
        text: What the paper says.
        where: Its figure, table or theorem.
        sections: The parts of the results that the judgement needs; the first shows it.
        judge: Returns what was found, from the results.
    """

    text: str
    where: str
    sections: tuple[str, ...]
    judge: Callable[[Data], Finding]


CLAIMS = (
    Claim(
        "Nominal CBF does not stay safe",
        "Fig. 1(a)",
        ("test_1",),
        figure_1.nominal_collides,
    ),
    Claim(
        "The proposed method, DOB-CBF and robust CBF pass the sphere and arrive",
        "Fig. 1(a)",
        ("test_1",),
        figure_1.others_arrive,
    ),
    Claim(
        "The proposed method has the lowest h of these, and h > 0",
        "Fig. 1(b)",
        ("test_1",),
        figure_1.proposed_is_closest,
    ),
    Claim(
        "The observer's estimate is accurate",
        "Fig. 1(c)",
        ("test_1",),
        figure_1.estimate_is_accurate,
    ),
    Claim(
        "The estimate's error stays below δ1 exp(-λ_V t/2)",
        "Lemma 2",
        ("test_1", "test_2"),
        figure_1.error_bound_holds,
    ),
    Claim(
        "The proposed method arrives; DOB-CBF stops part of the way",
        "Fig. 2(a)",
        ("test_2",),
        figure_2.only_proposed_arrives,
    ),
    Claim("The slack is zero", "Fig. 2(b)", ("test_2",), figure_2.slack_is_zero),
    Claim(
        "V_v of the proposed method is always the higher",
        "Fig. 2(c)",
        ("test_2",),
        figure_2.volume_is_higher,
    ),
    Claim(
        "V_v >= 0 all along", "Theorem 2", ("test_2",), figure_2.volume_stays_positive
    ),
    Claim(
        "A reference outside the set: the proposed method chooses an interior point,"
        " DOB-CBF one of the boundary",
        "Fig. 2(d)-(g)",
        ("test_2",),
        figure_2.proposed_maps_to_the_interior,
    ),
    Claim(
        "The feasible set of DOB-CBF vanishes, that of the proposed method does not",
        "Fig. 2(f), (g)",
        ("test_2",),
        figure_2.only_the_other_set_vanishes,
    ),
    Claim(
        "T1 > T2 from random starts",
        "Table I, case 1",
        ("table_1",),
        partial(table_1.runs_longer, case="case_1"),
    ),
    Claim(
        "T1 > T2 with random observer gains",
        "Table I, case 2",
        ("table_1",),
        partial(table_1.runs_longer, case="case_2"),
    ),
    Claim(
        "Both running times are shorter in case 2 than in case 1",
        "Table I",
        ("table_1",),
        table_1.gains_matter,
    ),
    Claim(
        "With the volume barrier the QP runs out of inputs more rarely",
        "the method's purpose",
        ("population_blimp",),
        table_1.infeasibility_is_rarer,
    ),
    Claim(
        "The proposed method avoids the obstacle and arrives",
        "Fig. 3",
        ("car_1",),
        car.car_avoids,
    ),
    Claim(
        "Robust CBF avoids it with a larger distance",
        "Fig. 3",
        ("car_1",),
        car.robust_goes_wide,
    ),
    Claim("Nominal CBF collides", "Fig. 3", ("car_1",), car.car_collides),
    Claim(
        "With the volume barrier the QP is feasible at all five gains",
        "Fig. 4",
        ("car_2",),
        car.all_gains_stay_feasible,
    ),
    Claim(
        "With the volume barrier the car arrives at all five gains",
        "Fig. 4",
        ("car_2",),
        car.all_gains_arrive,
    ),
    Claim(
        "Without it, k_p = 0.2 soon makes the QP infeasible",
        "Fig. 4",
        ("car_2",),
        car.slow_car_stops,
    ),
)


def verdicts(data: Data) -> list[Record]:
    """Returns the verdict on every claim whose parts of the results are there.

    ``reproduced``: the claim holds in the main setting and in those beside it.
    ``reproduced under stated conditions``: in the main setting only.
    ``undecided``: the trials are too few to tell.

    Args:
        data: The results.
    """
    return [
        _verdict(claim, data)
        for claim in CLAIMS
        if all(section in data for section in claim.sections)
    ]


def _verdict(claim: Claim, data: Data) -> Record:
    finding = claim.judge(data)
    return {
        "claim": claim.text,
        "where": claim.where,
        "found": _found(finding),
        "number": finding.number,
        "command": data[claim.sections[0]]["command"],
    }


def _found(finding: Finding) -> str:
    if finding.holds is None:
        return "undecided"
    if not finding.holds:
        return "not reproduced"
    if not finding.everywhere:
        return "reproduced under stated conditions"
    return "reproduced"
