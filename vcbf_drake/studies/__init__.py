"""Many runs: trials that vary a scenario, streamed to a file, compared in pairs."""

from vcbf_drake.studies.blimp_courses import blimp_course
from vcbf_drake.studies.car_courses import car_course
from vcbf_drake.studies.monte_carlo import run_study
from vcbf_drake.studies.statistics import share_interval, summarise_study
from vcbf_drake.studies.trial import Record, Trial, run_trial
from vcbf_drake.studies.variation import (
    BLIMP_COURSES,
    CAR_COURSES,
    TABLE_I,
    Courses,
    Variation,
)

__all__ = [
    "BLIMP_COURSES",
    "CAR_COURSES",
    "TABLE_I",
    "Courses",
    "Record",
    "Trial",
    "Variation",
    "blimp_course",
    "car_course",
    "run_study",
    "run_trial",
    "share_interval",
    "summarise_study",
]
