"""The paper's second car experiment: five approach gains between discs."""

from __future__ import annotations

from vcbf_drake.studies.car_courses import APPROACH_GAINS
from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.section import (
    Records,
    Section,
    entries,
    runs_under,
)
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT
from vcbf_drake.studies.trial import Record, Trial

SCENARIO = "car-sensitivity"
METHODS = (WITH, WITHOUT)


def car_2(settings: Settings) -> Section:
    """Returns the section: every approach gain with and without the volume barrier."""
    runs: dict[str, Trial] = {}
    for gain in APPROACH_GAINS:
        overrides = {"vehicle": {"controller": {"approach_gain": gain}}}
        runs |= runs_under(METHODS, SCENARIO, _key(gain), overrides)

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            "description": _DESCRIPTION,
            "gains": APPROACH_GAINS,
            "runs": {
                f"k_p={gain}": entries(archive, runs, _key(gain))
                for gain in APPROACH_GAINS
            },
        }

    return Section("car_2", evaluate, runs)


def _key(gain: float) -> str:
    return f"car_2/k_p={gain}"


_DESCRIPTION = (
    "The paper's approach gains k_p; discs, limits and push are ours. The gain scales"
    " the reference speed, and a slow car has little steering authority: its column in"
    " a barrier's row is proportional to the speed."
)
