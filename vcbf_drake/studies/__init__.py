"""Many runs: trials that vary a scenario, streamed to a file, compared in pairs."""

from vcbf_drake.studies.monte_carlo import run_study
from vcbf_drake.studies.statistics import summarise_study
from vcbf_drake.studies.trial import Record, Trial, run_trial
from vcbf_drake.studies.variation import TABLE_I, Variation

__all__ = [
    "TABLE_I",
    "Record",
    "Trial",
    "Variation",
    "run_study",
    "run_trial",
    "summarise_study",
]
