"""Many runs of any scenario: trials, streamed to a file, compared in pairs."""

from vcbf_drake.studies.statistics import (
    mean_interval,
    share_interval,
    summarise_study,
)
from vcbf_drake.studies.trial import Record, Trial, run_study, run_trial
from vcbf_drake.studies.variation import (
    Draw,
    PythonVariation,
    Variation,
    load_variation,
)

__all__ = [
    "Draw",
    "PythonVariation",
    "Record",
    "Trial",
    "Variation",
    "load_variation",
    "mean_interval",
    "run_study",
    "run_trial",
    "share_interval",
    "summarise_study",
]
