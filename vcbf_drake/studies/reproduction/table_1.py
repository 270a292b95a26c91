"""Table I of the paper: random starts, and random gains of the observer."""

from __future__ import annotations

from collections.abc import Sequence

from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.section import Records, Section
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT, describe
from vcbf_drake.studies.statistics import summarise_study
from vcbf_drake.studies.trial import Record, Trial
from vcbf_drake.studies.variation import TABLE_I, Courses, Variation

SCENARIO = "blimp-multiple-obstacles"

# The mean running times that the paper prints [s].
PAPER = {1: {"T1": 18.22, "T2": 10.67}, 2: {"T1": 16.21, "T2": 8.67}}


def paired_trials(
    scenario: str,
    count: int,
    variation: Variation | Courses,
    overrides: str = "",
    methods: Sequence[str] = (WITHOUT, WITH),
) -> list[Trial]:
    """Returns trials of a study, in pairs that share their draw.

    Args:
        scenario: A shipped scenario's name.
        count: How many draws.
        variation: What is drawn.
        overrides: YAML text with values that replace the scenario's.
        methods: The safety filters.
    """
    return [
        Trial(scenario, method, index, 0, variation, overrides)
        for index in range(count)
        for method in methods
    ]


def table_1(settings: Settings) -> Section:
    """Returns the section: both cases with the paper's ranges, on Test 2's course."""
    studies = {
        _file(case): paired_trials(SCENARIO, settings.trials, TABLE_I[case])
        for case in PAPER
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        cases = {
            f"case_{case}": _case(case, studies[_file(case)], records[_file(case)])
            for case in PAPER
        }
        return {"description": _DESCRIPTION, **cases}

    return Section("table_1", evaluate, studies=studies)


def _file(case: int) -> str:
    return f"table_1_case_{case}"


def _case(case: int, trials: Sequence[Trial], records: Sequence[Record]) -> Record:
    study = summarise_study(trials, records)
    variation = TABLE_I[case]
    return {
        "file": f"studies/{_file(case)}.jsonl",
        "command": f"vcbf-drake monte-carlo {SCENARIO} --case {case}"
        f" --trials {len(trials) // 2}",
        "ranges": {"start": variation.start, **dict(variation.observer)},
        "paper": PAPER[case],
        "T1": _running_time(study, WITH),
        "T2": _running_time(study, WITHOUT),
        "worse": [
            {"seed": each["index"], **each}
            for each in study["comparisons"][0]["worse_trials"]
        ],
        **study,
        "methods": {m: describe(records, m) for m in study["methods"]},
    }


def _running_time(study: Record, method: str) -> Record:
    numbers = study["methods"][method]
    return {"mean": numbers["mean_running_time"], "interval": numbers["interval"]}


_DESCRIPTION = (
    "Running time: to the first tick without a feasible input, at most 20 s; arriving"
    " counts 20 s. T1 is that of dob-vcbf-qp, T2 that of dob-cbf-qp; means with 95 %"
    " bootstrap intervals. The draws are uniform, a pair shares its draw. Ranges and"
    " gains are the paper's, course, thrust and wind are ours."
)
