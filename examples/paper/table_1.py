"""Table I of the paper: random starts, and random gains of the observer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from vcbf_drake.studies import Record, Trial, Variation, summarise_study
from vcbf_drake.viz.running_time_figure import running_time_figure

from .archive import Archive
from .experiment import (
    WITH,
    WITHOUT,
    Claim,
    Experiment,
    Finding,
    Numbers,
    Plan,
    Records,
    Settings,
    describe,
    is_above,
    paired_trials,
)
from .report import Block, Figure
from .words import OUTCOMES, TITLES, between, fixed, label, mean_time, table

SCENARIO = "blimp-multiple-obstacles"
# The paper's ranges; its distribution is not given, uniform is ours.
RANDOM_STARTS = Variation(
    "{initial_state.0: !Add [-0.1, 0.1], initial_state.1: !Add [-0.1, 0.1],"
    " initial_state.2: !Add [0.0, 0.2]}",
    "case-1",
)
RANDOM_GAINS = Variation(
    "{observer.alpha: !Uniform [4.6, 6.0], observer.beta: !Uniform [5.0, 7.0],"
    " observer.gamma: !Uniform [3.6, 4.4]}",
    "case-2",
)
CASES = {
    "case_1": ("Case 1, random starts", RANDOM_STARTS),
    "case_2": ("Case 2, random observer gains", RANDOM_GAINS),
}
# T1 is the proposed method's mean running time, T2 the one without volume barrier.
METHODS = {"T1": WITH, "T2": WITHOUT}
# The mean running times that the paper prints [s].
PAPER = {
    "case_1": {"T1": 18.22, "T2": 10.67},
    "case_2": {"T1": 16.21, "T2": 8.67},
}


# Run ---------------------------------------------------------------------------------


def plan(settings: Settings) -> Plan:
    """Returns both cases with the paper's ranges, on Test 2's course."""
    studies = {
        f"table_1_{key}": paired_trials(SCENARIO, settings.trials, variation)
        for key, (_, variation) in CASES.items()
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            key: _case(key, studies[f"table_1_{key}"], records[f"table_1_{key}"])
            for key in CASES
        }

    return Plan(evaluate, studies=studies)


def _case(key: str, trials: Sequence[Trial], records: Sequence[Record]) -> Record:
    study = summarise_study(trials, records)
    times = {
        name: {
            "mean": study["methods"][method]["mean_running_time"],
            "interval": study["methods"][method]["interval"],
        }
        for name, method in METHODS.items()
    }
    return {
        "file": f"studies/table_1_{key}.jsonl",
        "command": f"vcbf-drake monte-carlo {SCENARIO} --trials {len(trials) // 2}"
        f' --vary "{CASES[key][1].text}"',
        "paper": PAPER[key],
        **times,
        **study,
        "methods": {m: describe(records, m) for m in study["methods"]},
    }


# Judge -------------------------------------------------------------------------------


def runs_longer(data: Numbers, case: str) -> Finding:
    """Table I: T1 > T2."""
    numbers = data["table_1"][case]
    own, other, paper = numbers["T1"], numbers["T2"], numbers["paper"]
    number = (
        f"T1 {mean_time(own)}, T2 {mean_time(other)};"
        f" paper {paper['T1']} and {paper['T2']} s"
    )
    holds = is_above(own["interval"], other["interval"])
    if "population_blimp" not in data:
        return Finding(holds, True, number)
    methods = data["population_blimp"]["methods"]
    own, other = (
        {"mean": methods[m]["mean_running_time"], "interval": methods[m]["interval"]}
        for m in (WITH, WITHOUT)
    )
    return Finding(
        holds,
        is_above(own["interval"], other["interval"]) is True,
        f"{number}; over random courses {mean_time(own)} and {mean_time(other)}",
    )


def gains_matter(data: Numbers) -> Finding:
    """Table I: random gains shorten both running times by two seconds."""
    first, second = data["table_1"]["case_1"], data["table_1"]["case_2"]
    shorter = [
        is_above(first[name]["interval"], second[name]["interval"]) for name in METHODS
    ]
    # One that is not decides; else one that is undecided does.
    holds = False if False in shorter else None if None in shorter else True
    return Finding(
        holds,
        True,
        f"T1 {mean_time(first['T1'])} and {mean_time(second['T1'])},"
        f" T2 {mean_time(first['T2'])} and {mean_time(second['T2'])} in cases 1 and 2",
    )


# Show --------------------------------------------------------------------------------


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields the means beside the paper's, the outcomes, and every pair of trials."""
    yield (
        "The running time is the time of the first infeasible tick, at most 20 s; a"
        " run that arrives counts 20 s. T1 is that of dob-vcbf-qp, T2 that of"
        " dob-cbf-qp; means with 95 % bootstrap intervals. The draws are uniform, and"
        " both runs of a pair share a draw. Ranges and gains are the paper's; course,"
        " thrust and wind are ours."
    )
    yield _means(numbers)
    for key in CASES:
        yield from _pairs(key, numbers[key], archive)


def _means(numbers: Numbers) -> str:
    rows = [
        (key, name, method, numbers[key]["methods"][method])
        for key in CASES
        for name, method in METHODS.items()
    ]
    shown = [o for o in OUTCOMES if any(o in trials["outcomes"] for *_, trials in rows)]
    return table(
        "Table I of the paper beside ours: mean running times with 95 % intervals,"
        " and the outcomes of the trials. The paper gives neither the number of its"
        " trials nor an interval nor its layout.",
        [
            *("case", "", "method", "paper [s]", "here [s]", "95 % interval", "trials"),
            *(TITLES.get(outcome, outcome) for outcome in shown),
        ],
        [
            [
                CASES[key][0],
                name,
                label(method),
                fixed(PAPER[key][name]),
                fixed(trials["mean_running_time"]),
                between(trials["interval"]),
                str(trials["trials"]),
                *(str(trials["outcomes"].get(outcome, 0)) for outcome in shown),
            ]
            for key, name, method, trials in rows
        ],
        merged=1,
    )


def _pairs(key: str, case: Numbers, archive: Archive) -> Iterator[Block]:
    title, comparison = CASES[key][0], case["comparisons"][0]
    yield Figure(
        f"table_1_{key}",
        f"{title}: every pair of trials as one column, both methods from the same draw,"
        " in the order of the running time without the volume barrier. At the right the"
        f" means with their 95 % intervals. The volume barrier did better in"
        f" {comparison['better']} of {comparison['pairs']} pairs, the same in"
        f" {comparison['same']} and worse in {comparison['worse']}.",
        lambda: running_time_figure(archive.records(case["file"]), case),
        case["command"],
    )
    for words, trials in (
        ("in which the volume barrier did worse", comparison["worse_trials"]),
        ("that crashed, and are in no mean", case["errors"]),
    ):
        if trials:
            commands = [f"* `{trial['replay']}`" for trial in trials]
            head = f"{title}: the {len(trials)} trials {words}, to run again:\n"
            yield "\n".join([head, *commands])
    if not comparison["worse_trials"]:
        yield f"{title}: in no trial did the volume barrier do worse."


EXPERIMENT = Experiment(
    "table_1",
    "Table I: random starts and gains",
    plan,
    show,
    claims=(
        Claim(
            "T1 > T2 from random starts",
            "Table I, case 1",
            partial(runs_longer, case="case_1"),
        ),
        Claim(
            "T1 > T2 with random observer gains",
            "Table I, case 2",
            partial(runs_longer, case="case_2"),
        ),
        Claim(
            "Both running times are shorter in case 2 than in case 1",
            "Table I",
            gains_matter,
        ),
    ),
)
