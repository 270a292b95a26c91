"""Courses that nobody chose: how often each filter fails, and what helps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vcbf_drake.studies.blimp_courses import (
    BLIMP_COURSE_RANGES,
    SPHERE_COUNTS,
    SPHERE_SPREAD,
)
from vcbf_drake.studies.car_courses import (
    APPROACH_GAINS,
    BARRIER_GAINS,
    CAR_COURSE_RANGES,
    OTHER_DISCS,
)
from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.section import Records, Section, text
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import (
    describe,
    failed,
    failure_rates,
    pairs,
    share,
)
from vcbf_drake.studies.reproduction.table_1 import paired_trials
from vcbf_drake.studies.statistics import summarise_study
from vcbf_drake.studies.trial import Record, Trial
from vcbf_drake.studies.variation import BLIMP_COURSES, CAR_COURSES

BLIMP, CAR = "blimp-multiple-obstacles", "car-sensitivity"


def population_blimp(settings: Settings) -> Section:
    """Returns the section: random courses of the blimp, each under both filters."""
    name = "population_blimp"
    trials = paired_trials(BLIMP, settings.blimp_courses, BLIMP_COURSES)

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            "description": _DESCRIPTION,
            "generator": {
                "function": "vcbf_drake.studies.blimp_course(seed)",
                "scenario": BLIMP,
                "ranges": dict(BLIMP_COURSE_RANGES),
                "spheres": SPHERE_COUNTS,
                "sphere spread [m]": SPHERE_SPREAD,
            },
            "layouts": settings.blimp_courses,
            "file": f"studies/{name}.jsonl",
            **_population(trials, records[name]),
        }

    return Section(name, evaluate, studies={name: trials})


def population_car(settings: Settings) -> Section:
    """Returns the section: random courses of the car, each at every approach gain."""
    studies = {
        f"population_car_{gain}": paired_trials(
            CAR,
            settings.car_courses,
            CAR_COURSES,
            text({"vehicle": {"controller": {"approach_gain": gain}}}),
        )
        for gain in APPROACH_GAINS
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        by_gain = {
            gain: {
                "file": f"studies/{name}.jsonl",
                **_population(studies[name], records[name]),
            }
            for gain, name in zip(APPROACH_GAINS, studies, strict=True)
        }
        together = [pair for name in studies for pair in pairs(records[name])]
        rates = failure_rates(together)
        for rate in rates.values():
            rate["interval"] = None  # The gains of a course are not independent.
        return {
            "description": _CAR_DESCRIPTION,
            "generator": {
                "function": "vcbf_drake.studies.car_course(seed)",
                "scenario": CAR,
                "ranges": dict(CAR_COURSE_RANGES),
                "barrier gains": BARRIER_GAINS,
                "other discs": OTHER_DISCS,
            },
            "layouts": settings.car_courses,
            "approach_gains": APPROACH_GAINS,
            "rates": rates,
            "layouts_with_a_failure": {
                method: _layouts_with_a_failure(records, method)
                for method in ("dob-cbf-qp", "dob-vcbf-qp")
            },
            "by_gain": {str(gain): numbers for gain, numbers in by_gain.items()},
        }

    return Section("population_car", evaluate, studies=studies)


def _population(trials: Sequence[Trial], records: Sequence[Record]) -> Record:
    study = summarise_study(trials, records)
    return {
        "counts": {
            method: numbers["outcomes"] for method, numbers in study["methods"].items()
        },
        "rates": failure_rates(list(pairs(records))),
        **study,
        "methods": {m: describe(records, m) for m in study["methods"]},
    }


def _layouts_with_a_failure(records: Mapping[str, Any], method: str) -> Record:
    """In how many layouts a method fails at some approach gain."""
    fails: dict[int, bool] = {}
    for study in records.values():
        for record in study:
            if record["method"] == method and record["error"] is None:
                index = record["index"]
                fails[index] = fails.get(index, False) or failed(record)
    return share(sum(fails.values()), len(fails))


_DESCRIPTION = (
    "Every course is flown with and without the volume barrier; none is left out."
    " Outcomes within 20 s."
)
_CAR_DESCRIPTION = (
    "Every course is driven at each approach gain with and without the volume barrier;"
    " none is left out. Outcomes within 30 s; rates are over pairs of a course and a"
    " gain unless they say layouts."
)
