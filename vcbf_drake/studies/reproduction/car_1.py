"""The paper's first car experiment: a pushed car passes a disc."""

from __future__ import annotations

from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.section import (
    Records,
    Section,
    entries,
    runs_under,
)
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.trial import Record

SCENARIO = "car-avoidance"
METHODS = ("dob-vcbf-qp", "robust-cbf-qp", "cbf-qp")


def car_1(settings: Settings) -> Section:
    """Returns the section: the paper's three methods."""
    runs = runs_under(METHODS, SCENARIO, "car_1")

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            "description": _DESCRIPTION,
            "command": f"vcbf-drake compare {SCENARIO} --methods {','.join(METHODS)}",
            "runs": entries(archive, runs, "car_1"),
        }

    return Section("car_1", evaluate, runs)


_DESCRIPTION = (
    "The paper drives a real car and prints paths only: vehicle model and the form of"
    " the barrier are the paper's, every number is ours."
)
