"""An experiment of the paper: the runs it needs, its claims, and its part of a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from vcbf_drake.simulation.loading import merge_overrides
from vcbf_drake.studies import Draw, Record, Trial, share_interval
from vcbf_drake.studies.statistics import summarise_method

if TYPE_CHECKING:
    from .archive import Archive
    from .report import Block

Numbers = Mapping[str, Any]
Records = Mapping[str, Sequence[Record]]

WITH, WITHOUT = "dob-vcbf-qp", "dob-cbf-qp"
WANG_XU, ROBUST, NOMINAL = "wang-xu-dob-cbf-qp", "robust-cbf-qp", "cbf-qp"


@dataclass(frozen=True)
class Settings:
    """How many trials each part takes; single runs are the same in all.

    Attributes:
        quick: Whether this is a check rather than evidence.
        trials: Pairs of trials in each case of Table I.
        blimp_courses: Random courses of the blimp.
        car_courses: Random courses of the car, each driven at every approach gain.
        chatter_trials: Pairs of trials for each observer of the counter-example.
        ablation_trials: Trials for each set of corrections.
        knob_trials: Trials for each value of a knob.
    """

    quick: bool = False
    trials: int = 200
    blimp_courses: int = 600
    car_courses: int = 60
    chatter_trials: int = 6
    ablation_trials: int = 24
    knob_trials: int = 8


FULL, QUICK = Settings(), Settings(True, 4, 6, 2, 1, 1, 1)


@dataclass(frozen=True)
class Plan:
    """The runs of an experiment, and the numbers that follow from them.

    Attributes:
        evaluate: Returns the experiment's numbers, from the archive, which holds the
            runs, and the records of each of its studies.
        runs: Single runs that are kept whole, by their places below ``runs/``.
        studies: Trials of which only the records are kept, by the names of their files.
    """

    evaluate: Callable[[Archive, Records], Record]
    runs: Mapping[str, Trial] = field(default_factory=dict)
    studies: Mapping[str, Sequence[Trial]] = field(default_factory=dict)

    @property
    def cost(self) -> int:
        """How many runs it takes."""
        return len(self.runs) + sum(map(len, self.studies.values()))


class Finding(NamedTuple):
    """The answer of the results to a claim.

    Attributes:
        holds: Whether the claim holds in the main setting; None when there are too few
            trials to tell.
        everywhere: Whether it also holds in the settings that stand beside it.
        number: The numbers that say so.
    """

    holds: bool | None
    everywhere: bool
    number: str

    @property
    def verdict(self) -> str:
        """The verdict: reproduced, under stated conditions, undecided, or not."""
        if self.holds is None:
            return "undecided"
        if not self.holds:
            return "not reproduced"
        if not self.everywhere:
            return "reproduced under stated conditions"
        return "reproduced"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and who judges it.

    Attributes:
        text: What the paper says.
        where: Its figure, table or theorem.
        judge: Returns what was found, from the numbers of all experiments.
        needs: Keys of other experiments without which it cannot be judged.
    """

    text: str
    where: str
    judge: Callable[[Numbers], Finding]
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """One part of the reproduction.

    Attributes:
        key: Its name in the results and on the command line.
        title: Its heading.
        plan: Returns what to run.
        show: Yields its part of the report from its numbers.
        claims: The paper's claims that it judges.
    """

    key: str
    title: str
    plan: Callable[[Settings], Plan]
    show: Callable[[Numbers, Archive], Iterator[Block]]
    claims: Sequence[Claim] = ()


def verdicts(experiments: Iterable[Experiment], data: Numbers) -> list[Record]:
    """Returns the verdict on every claim whose experiments are in the results."""
    return [
        {
            "claim": claim.text,
            "where": claim.where,
            "found": finding.verdict,
            "number": finding.number,
            "command": data[experiment.key]["command"],
        }
        for experiment in experiments
        for claim in experiment.claims
        if all(key in data for key in (experiment.key, *claim.needs))
        for finding in [claim.judge(data)]
    ]


# Runs and trials ---------------------------------------------------------------------


def text(overrides: Numbers) -> str:
    """Returns overrides as trials take them: one line of YAML, empty for none."""
    return merge_overrides(overrides) if overrides else ""


def runs_under(
    methods: Sequence[str], scenario: str, key: str, overrides: Numbers | None = None
) -> dict[str, Trial]:
    """Returns a scenario's runs under several methods, by their places ``KEY/METHOD``.

    Args:
        methods: The safety filters.
        scenario: A shipped scenario's name.
        key: Their common place.
        overrides: Values that replace the scenario's.
    """
    return {
        f"{key}/{method}": Trial(scenario, method, 0, overrides=text(overrides or {}))
        for method in methods
    }


def entries(archive: Archive, runs: Mapping[str, Trial], key: str) -> dict[str, Record]:
    """Returns what the results say of the runs below a key, by method."""
    return {
        trial.method: {
            "run": f"runs/{place}",
            "summary": archive.summary(place),
            "command": trial.command(),
        }
        for place, trial in runs.items()
        if place.rpartition("/")[0] == key
    }


@dataclass(frozen=True)
class Courses:
    """Random courses in place of the scenario's own; the index is a course's seed.

    Attributes:
        name: Their name in records.
        course: Returns the course of a seed, as overrides of the scenario.
    """

    name: str
    course: Callable[[int], dict[str, Any]]

    def draw(self, scenario: Any, seed: int, index: int) -> dict[str, Any]:
        """Returns a course; it is the same in all studies."""
        return self.course(index)


def paired_trials(
    scenario: str,
    count: int,
    variation: Draw,
    overrides: str = "",
    methods: Sequence[str] = (WITHOUT, WITH),
) -> list[Trial]:
    """Returns trials of a study, in pairs that share their draw."""
    return [
        Trial(scenario, method, index, 0, variation, overrides)
        for index in range(count)
        for method in methods
    ]


# Shares and intervals ----------------------------------------------------------------


def share(count: int, total: int) -> Record:
    """Returns a share with Wilson's 95 % interval, as a dict that JSON can hold."""
    return {
        "count": count,
        "of": total,
        "rate": count / total if total else None,
        "interval": share_interval(count, total),
    }


def describe(records: Sequence[Record], method: str) -> Record:
    """Returns outcomes, running time and extremes of a method's trials."""
    ended = [r for r in records if r["method"] == method and r["error"] is None]

    slacks = [r["max_abs_slack"] for r in ended if r["max_abs_slack"] is not None]
    return {
        **summarise_method(method, records),
        "greatest_slack": max(slacks, default=None),
        "with_slack": share(sum(r["max_abs_slack"] > 0.0 for r in ended), len(ended)),
    }


def failed(record: Numbers) -> bool:
    """Whether a run ran out of feasible inputs or collided."""
    return record["outcome"] in ("infeasible", "collision")


def pairs(records: Sequence[Record]) -> Iterator[Mapping[str, Record]]:
    """Yields the records of each draw by method, unless one of its trials crashed."""
    draws: dict[int, dict[str, Record]] = {}
    for record in records:
        draws.setdefault(record["index"], {})[record["method"]] = record
    for pair in draws.values():
        if all(record["error"] is None for record in pair.values()):
            yield pair


def failure_rates(all_pairs: Sequence[Mapping[str, Record]]) -> dict[str, Record]:
    """Returns how often each filter fails, and what the volume barrier does about it.

    To fail is to run out of feasible inputs or to collide.

    Args:
        all_pairs: Each with a record of both filters.
    """
    lost = [pair for pair in all_pairs if failed(pair[WITHOUT])]
    kept = [pair for pair in all_pairs if not failed(pair[WITHOUT])]

    def count(among: Sequence[Mapping[str, Record]], *outcomes: str) -> Record:
        return share(sum(p[WITH]["outcome"] in outcomes for p in among), len(among))

    fails = ("infeasible", "collision")
    return {
        "dob-cbf-qp fails": share(len(lost), len(all_pairs)),
        "dob-vcbf-qp fails": count(all_pairs, *fails),
        "of its failures, dob-vcbf-qp reaches": count(lost, "reached"),
        "of its failures, dob-vcbf-qp stays feasible": count(lost, "timeout"),
        "of its failures, dob-vcbf-qp fails too": count(lost, *fails),
        "of its successes, dob-vcbf-qp fails": count(kept, *fails),
    }


def is_above(interval: Any, other: Any) -> bool | None:
    """Whether the first interval is the higher; None when they overlap."""
    if interval is None or other is None:
        return None
    if interval[0] > other[1]:
        return True
    # Below, or two equal values without any spread: more trials change nothing.
    if interval[1] < other[0] or (*interval, *other) == 4 * (interval[0],):
        return False
    return None
