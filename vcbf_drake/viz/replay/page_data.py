"""The page over the replay: title, legend, clock, plots, and the data they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import html
from importlib.resources import files
import json
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.plants.vehicle import tag
from vcbf_drake.viz.feasible_set import (
    FeasibleSet,
    feasible_set_of_tick,
    shadow,
    shown_inputs,
)
from vcbf_drake.viz.runs import Event, Run, barrier_unit, least_barrier
from vcbf_drake.viz.solids import hull
from vcbf_drake.viz.stage import Stage, multiples

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import InputLimits

MAX_SAMPLES = 800  # A plot is a few hundred pixels wide.
MAX_SETS = 400
SCRIPTS = "plots.js", "choice.js", "scene.js", "player.js"


@dataclass(frozen=True)
class Shown:
    """A run as the page shows it.

    Attributes:
        label: Its name.
        color: Its hexadecimal colour.
        dashes: On and off lengths [pixels]; empty for a solid line.
        events: What happened.
        path: Where the label is at every frame, shape (F, 3) [m].
        time: The times of what its log holds, shape (T,) [s].
        log: The arrays of a `Result`'s log that the plots show; empty without a filter.
        limits: The input's limits.
    """

    label: str
    color: str
    dashes: tuple[float, ...]
    events: Sequence[Event]
    path: Array
    time: Array
    log: Mapping[str, Array]
    limits: InputLimits | None


@dataclass(frozen=True)
class Words:
    """What the card says.

    Attributes:
        title: The first line, and the page's title.
        description: What is shown.
        remark: What has to be said for the picture to be read rightly.
    """

    title: str
    description: str = ""
    remark: str = ""


def overlay_html(words: Words, data: Mapping[str, Any]) -> str:
    """What goes before ``</body>`` of Meshcat's page.

    Args:
        words: What the card says.
        data: What the page's scripts show, JSON values only.

    Returns:
        HTML with its style, its data and its scripts.
    """
    # In JSON inside HTML only "<" could end the element early.
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return Template(_text("page.html")).substitute(
        title=html.escape(words.title),
        description=html.escape(words.description),
        remark=html.escape(words.remark),
        style=_text("page.css"),
        data=text.replace("<", "\\u003c"),
        script="\n".join(map(_text, SCRIPTS)),
    )


def stage_words(stage: Stage) -> Words:
    """The card of a stage: the scenario's title, which its description starts with."""
    scenario = stage.run.scenario
    title, _, rest = scenario.description.strip().partition("\n")
    title = title.strip().rstrip(".") or scenario.name
    return Words(title, " ".join(rest.split()), _remark(stage))


def stage_data(stage: Stage, live: bool = False) -> dict[str, Any]:
    """The page's data of a stage; of a run that goes on, what it has at the start."""
    shown = [
        Shown(
            run.label,
            run.color,
            run.dashes,
            run.events,
            motion.position,
            run.time,
            run.result.log,
            run.scenario.input_set,
        )
        for run, motion in zip(stage.runs, stage.motions, strict=True)
    ]
    unit = barrier_unit(stage.run.scenario)
    return {
        "duration": stage.duration,
        "frames_per_second": stage.frames_per_second,
        "live": live,
        **series_data(shown, stage.run.channels.input_labels, unit, live),
        "camera": _camera(stage),
        "sizes": {
            "vehicle": stage.rise,
            "marker": stage.mark,
        },
        "labels": _labels(stage),
        "round": len(stage.solids) < 100,  # Few enough for finer balls than Meshcat's.
    }


def series_data(
    shown: Sequence[Shown], inputs: Sequence[str], unit: str, live: bool = False
) -> dict[str, Any]:
    """The page's runs, plots and feasible sets; ``None`` where a number is missing.

    Args:
        shown: The runs, the one to bring out last.
        inputs: The inputs' names with units.
        unit: The barriers' unit; empty where they have several.
        live: Whether more is to come: nobody knows of the slack yet.
    """
    has_filter = bool(shown[-1].log)
    return {
        "runs": [run_data(run) for run in shown],
        "plots": _plots(shown, inputs, unit, live) if has_filter else [],
        "choice": _choice_axes(shown[-1], inputs) if has_filter else None,
    }


def _plots(
    shown: Sequence[Shown], inputs: Sequence[str], unit: str, live: bool
) -> list[dict[str, Any]]:
    """The plots: barrier, volume, and the slack, or the inputs where it is nothing."""
    barrier = f"Barrier min h [{unit}]" if unit else "Barrier min h"
    plots = [
        _plot(barrier, "unsafe below 0", "barrier"),
        _plot("Volume barrier Vᵥ [-]", "room left for inputs", "volume"),
    ]
    slack = [np.asarray(run.log["slack"], float) for run in shown]
    if any(np.any(np.abs(each[np.isfinite(each)]) > 1e-9) for each in slack):
        note = "how far the volume row gave way"
        return [*plots, _plot("Slack δ [-]", note, "slack", below=False)]
    limits = shown[-1].limits
    assert limits is not None  # Of a run with a filter.
    lanes = [
        {
            "key": f"input{channel}",
            "name": name,
            "limits": [low, high] if np.isfinite([low, high]).all() else None,
        }
        for channel, (name, low, high) in enumerate(
            zip(inputs, limits.lower, limits.upper, strict=True)
        )
    ]
    note = "and limits" if live else "and limits; the slack is 0 throughout"
    return [*plots, {"title": "Inputs", "note": note, "below": False, "lanes": lanes}]


def _plot(title: str, note: str, key: str, below: bool = True) -> dict[str, Any]:
    """A plot of one series of every run; what is below 0 may be shaded."""
    lanes = [{"key": key, "name": "", "limits": None}]
    return {"title": title, "note": note, "below": below, "lanes": lanes}


def run_data(run: Shown) -> dict[str, Any]:
    """A run as the page has it."""
    kept, log = _kept(len(run.time), MAX_SAMPLES), run.log
    data: dict[str, Any] = {
        "label": run.label,
        "color": run.color,
        "dashes": " ".join(map(str, run.dashes)),
        "events": [vars(event) for event in run.events],
        "path": run.path.round(3).tolist(),
        "time": _finite(run.time[kept]),
    }
    if not log:
        return data
    inputs = np.asarray(log["input"], dtype=float)[kept]
    return data | {
        "barrier": _finite(least_barrier(log)[kept]),
        "volume": _finite(np.asarray(log["volume"], dtype=float)[kept]),
        "slack": _finite(np.asarray(log["slack"], dtype=float)[kept]),
        **{f"input{k}": _finite(each) for k, each in enumerate(inputs.T)},
        "sets": _sets(run),
    }


def _choice_axes(run: Shown, inputs: Sequence[str]) -> dict[str, Any]:
    """The plane of the first two inputs, in which the feasible sets are shown."""
    assert run.limits is not None  # Of a run with a filter.
    names, (low, high) = list(inputs), shown_inputs(run.log, run.limits)
    if len(names) == 1:  # A band, for the eye.
        low, high, names = np.append(low, -1.0), np.append(high, 1.0), [*names, ""]
    others = f"; the other {len(names) - 2} not shown" if len(names) > 3 else ""
    return {
        "names": names[:2],
        "low": _rounded(low[:2]),
        "high": _rounded(high[:2]),
        "note": f"their shadow on two inputs{others}" if len(names) > 2 else "",
    }


def _sets(run: Shown) -> dict[str, list[Any]]:
    """The feasible sets of a run over time, as shadows on the first two inputs.

    An ellipse is its centre and the lower triangle that takes the unit circle to it.
    """
    assert run.limits is not None  # Of a run with a filter.
    kept = _kept(len(run.time), MAX_SETS)
    sets = [feasible_set_of_tick(run.log, run.limits, int(tick)) for tick in kept]
    return {
        "time": _finite(run.time[kept]),
        "outline": [_outline(each) for each in sets],
        "eased": [int(each.empty and each.has_choice) for each in sets],
        "ellipse": [_ellipse(each) for each in sets],
        "reference": [_place_in_plane(each.reference) for each in sets],
        "input": [_in_plane(each.input) for each in sets],
    }


def _outline(feasible: FeasibleSet) -> list[float]:
    """The outline's corners, one coordinate after the other; nothing when empty."""
    corners = feasible.corners[:, :2]
    if corners.shape[1] == 1 and len(corners):
        (low,), (high,) = corners.min(axis=0), corners.max(axis=0)
        corners = np.array([[low, -0.5], [high, -0.5], [high, 0.5], [low, 0.5]])
    return _rounded(hull(corners).ravel()) if len(corners) else []


def _ellipse(feasible: FeasibleSet) -> list[float] | None:
    shape = feasible.shape
    if feasible.empty or not np.all(np.isfinite(shape)):
        return None
    if len(shape) == 1:
        return [*_in_plane(feasible.center), *_rounded([shape[0, 0], 0.0, 0.5])]
    return _rounded([*feasible.center[:2], *shadow(shape)[np.tril_indices(2)]])


def _in_plane(values: Array) -> list[float]:
    return _rounded(np.append(values[:2], 0.0)[:2])


def _place_in_plane(values: Array) -> list[float] | None:
    """The same, or nothing where it is not finite."""
    return _in_plane(values) if np.isfinite(values[:2]).all() else None


def _kept(ticks: int, most: int) -> NDArray[np.int_]:
    """Which of so many ticks are shown, the first and the last included."""
    kept: NDArray[np.int_] = np.unique(
        np.linspace(0, ticks - 1, min(ticks, most)).astype(int)
    )
    return kept


def _camera(stage: Stage) -> dict[str, Any]:
    """The points to show and the side to see them from: the target on the right."""
    way = stage.target - stage.start
    angle = np.arctan2(way[1], way[0]) - np.deg2rad(90.0 + 22.0)
    height = np.deg2rad(38.0 if stage.run.is_flat else 24.0)
    direction = [np.cos(angle), np.sin(angle), np.tan(height)]
    return {
        "points": stage.outline.round(3).tolist(),
        "span": stage.span,
        "direction": np.round(direction, 6).tolist(),
    }


def _labels(stage: Stage) -> list[dict[str, Any]]:
    labels: list[dict[str, Any]] = []
    for text, place in (("start", stage.start), ("target", stage.target)):
        labels.append(_label(text, place, "place", 1))
    toward = _camera(stage)["direction"]
    return labels + tick_labels(stage.low, stage.high, stage.cell, toward)


def tick_labels(
    low: Array, high: Array, cell: float, toward: Sequence[float]
) -> list[dict[str, Any]]:
    """Numbers along the floor's edge that is nearer to an eye in a direction."""
    marks = multiples(low[0], high[0], 5.0 * cell)
    edge = low[1] - 0.25 * cell if toward[1] < 0.0 else high[1] + 0.25 * cell
    places = [np.array([x, edge, low[2]]) for x in marks]
    return [
        _label(f"{x:g} m", place, "tick", 0)
        for x, place in zip(marks, places, strict=True)
    ]


def _label(text: str, place: Array, kind: str, side: int) -> dict[str, Any]:
    """A label above (side -1), on (0) or below (1) a place."""
    position = place.round(3).tolist()
    return {"text": text, "position": position, "kind": kind, "side": side}


def _remark(stage: Stage) -> str:
    """What has to be said for the picture to be read rightly."""
    name = tag(type(stage.run.vehicle)).removeprefix("!").lower()
    pale = "Pale: the other methods. " if len(stage.runs) > 1 else ""
    scale = f" It is drawn at 1:{stage.fraction}." if stage.fraction > 1 else ""
    outside = f"The {name}'s centre must stay outside the obstacles."
    return f"{pale}{outside}{scale}{_verdict(stage.run)}"


def _verdict(run: Run) -> str:
    """The audit's word on a run as a whole; nothing where there was none."""
    reasons = run.result.summary.get("reasons_against")
    if reasons is None:
        return ""
    if not reasons:
        return f" {run.label} (whole run): guaranteed, every promise kept."
    more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    return f" {run.label} (whole run): not guaranteed ({reasons[0]}{more})."


def _finite(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


def _rounded(values: ArrayLike) -> list[float]:
    return [float(f"{value:.4g}") for value in np.asarray(values)]


def _text(name: str) -> str:
    page = files("vcbf_drake.viz.replay") / "page" / name
    return page.read_text(encoding="utf-8")
