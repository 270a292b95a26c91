"""The page over the replay: title, legend, clock, plots, and the data they show."""

from __future__ import annotations

from collections.abc import Sequence
import html
from importlib.resources import files
import json
from string import Template
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.viz.feasible_set import (
    FeasibleSet,
    feasible_set_of_tick,
    polygon,
    shown_inputs,
)
from vcbf_drake.viz.runs import Run, barrier_unit
from vcbf_drake.viz.stage import Motion, Stage, multiples

MAX_SAMPLES = 800  # A plot is a few hundred pixels wide.
MAX_SETS = 400
SCRIPTS = "plots.js", "choice.js", "scene.js", "player.js"
_LETTERS = {r"\omega": "ω", r"\tau": "τ", r"\psi": "ψ"}


def overlay_html(stage: Stage) -> str:
    """What goes before ``</body>`` of Meshcat's page.

    Args:
        stage: What the replay shows.

    Returns:
        HTML with its style, its data and its scripts.
    """
    title, description = _words(stage)
    # In JSON inside HTML only "<" could end the element early.
    data = json.dumps(overlay_data(stage), allow_nan=False, separators=(",", ":"))
    return Template(_text("page.html")).substitute(
        title=html.escape(title),
        description=html.escape(description),
        remark=html.escape(_remark(stage)),
        style=_text("page.css"),
        data=data.replace("<", "\\u003c"),
        script="\n".join(map(_text, SCRIPTS)),
    )


def page_title(stage: Stage) -> str:
    """The page's title, as HTML."""
    return html.escape(f"{_words(stage)[0]} - vcbf_drake")


def overlay_data(stage: Stage) -> dict[str, Any]:
    """The data of the page: JSON values only, ``None`` where a number is missing."""
    return {
        "duration": stage.duration,
        "frames_per_second": stage.frames_per_second,
        "runs": [
            _run_data(run, motion)
            for run, motion in zip(stage.runs, stage.motions, strict=True)
        ],
        "plots": _plots(stage),
        "choice": _choice_axes(stage),
        "camera": _camera(stage),
        "sizes": {
            "vehicle": stage.geometry.rise / stage.fraction,
            "marker": stage.mark,
        },
        "labels": _labels(stage),
        "round": len(stage.spheres) < 100,  # Few enough for finer balls than Meshcat's.
    }


def _plots(stage: Stage) -> list[dict[str, Any]]:
    """The plots: barrier, volume, and the slack, or the inputs where it is nothing."""
    unit = barrier_unit(stage.runs[-1].result.scenario)
    plots = [
        _plot(f"Barrier min h [{unit}]", "unsafe below 0", "barrier"),
        _plot("Volume barrier Vᵥ [-]", "room left for inputs", "volume"),
    ]
    slack = [np.asarray(run.result.log["slack"], float) for run in stage.runs]
    if any(np.any(np.abs(each[np.isfinite(each)]) > 1e-9) for each in slack):
        note = "how far the volume row gave way"
        return [*plots, _plot("Slack δ [-]", note, "slack", below=False)]
    limits = stage.runs[-1].result.scenario.input_set
    lanes = [
        {
            "key": f"input{channel}",
            "name": name,
            "limits": [low, high] if np.isfinite([low, high]).all() else None,
        }
        for channel, (name, low, high) in enumerate(
            zip(_plain(stage.geometry.inputs), limits.lower, limits.upper, strict=True)
        )
    ]
    note = "and limits; the slack is 0 throughout"
    return [*plots, {"title": "Inputs", "note": note, "below": False, "lanes": lanes}]


def _plot(title: str, note: str, key: str, below: bool = True) -> dict[str, Any]:
    """A plot of one series of every run; what is below 0 may be shaded."""
    lanes = [{"key": key, "name": "", "limits": None}]
    return {"title": title, "note": note, "below": below, "lanes": lanes}


def _run_data(run: Run, motion: Motion) -> dict[str, Any]:
    kept, log = _kept(len(run.time), MAX_SAMPLES), run.result.log
    inputs = np.asarray(log["input"], dtype=float)[kept]
    return {
        "label": run.label,
        "color": run.color,
        "dashes": " ".join(map(str, run.dashes)),
        "events": [vars(event) for event in run.events],
        "path": motion.position.round(3).tolist(),
        "time": _finite(run.time[kept]),
        "barrier": _finite(run.least_barrier[kept]),
        "volume": _finite(np.asarray(log["volume"], dtype=float)[kept]),
        "slack": _finite(np.asarray(log["slack"], dtype=float)[kept]),
        **{f"input{k}": _finite(each) for k, each in enumerate(inputs.T)},
        "sets": _sets(run),
    }


def _choice_axes(stage: Stage) -> dict[str, Any]:
    """The plane of the first two inputs, in which the feasible sets are shown."""
    result, names = stage.runs[-1].result, _plain(stage.geometry.inputs)
    low, high = shown_inputs(result)
    if len(names) == 1:  # A band, for the eye.
        low, high, names = np.append(low, -1.0), np.append(high, 1.0), [*names, ""]
    others = f"; the other {len(names) - 2} not shown" if len(names) > 3 else ""
    return {
        "names": names[:2],
        "low": _rounded(low[:2]),
        "high": _rounded(high[:2]),
        "note": f"their shadow on two inputs{others}" if len(names) > 2 else "",
    }


def _sets(run: Run) -> dict[str, list[Any]]:
    """The feasible sets of a run over time, as shadows on the first two inputs.

    An ellipse is its centre and the lower triangle that takes the unit circle to it.
    """
    kept = _kept(len(run.time), MAX_SETS)
    sets = [feasible_set_of_tick(run.result, int(tick)) for tick in kept]
    return {
        "time": _finite(run.time[kept]),
        "outline": [_outline(each) for each in sets],
        "ellipse": [_ellipse(each) for each in sets],
        "reference": [_in_plane(each.reference) for each in sets],
        "input": [_in_plane(each.input) for each in sets],
    }


def _outline(feasible: FeasibleSet) -> list[float]:
    """The outline's corners, one coordinate after the other; nothing when empty."""
    corners = feasible.corners[:, :2]
    if corners.shape[1] == 1 and len(corners):
        (low,), (high,) = corners.min(axis=0), corners.max(axis=0)
        corners = np.array([[low, -0.5], [high, -0.5], [high, 0.5], [low, 0.5]])
    return _rounded(polygon(corners).ravel()) if len(corners) else []


def _ellipse(feasible: FeasibleSet) -> list[float] | None:
    shape = feasible.shape
    if feasible.empty or not np.all(np.isfinite(shape)):
        return None
    if len(shape) == 1:
        return [*_in_plane(feasible.center), *_rounded([shape[0, 0], 0.0, 0.5])]
    # The shadow of {B v + c : |v| <= 1} on the plane has the matrix of its first rows.
    triangle = np.linalg.cholesky((shape @ shape.T)[:2, :2])
    return _rounded([*feasible.center[:2], *triangle[np.tril_indices(2)]])


def _in_plane(values: Array) -> list[float]:
    return _rounded(np.append(values[:2], 0.0)[:2])


def _kept(ticks: int, most: int) -> NDArray[np.int_]:
    """Which of so many ticks are shown, the first and the last included."""
    kept: NDArray[np.int_] = np.unique(
        np.linspace(0, ticks - 1, min(ticks, most)).astype(int)
    )
    return kept


def _plain(names: Sequence[str]) -> list[str]:
    """Names of inputs without TeX; what follows ``_`` is an index."""
    plain = []
    for name in names:
        for tex, letter in _LETTERS.items():
            name = name.replace(tex, letter)
        plain.append(name.replace("$", ""))
    return plain


def _camera(stage: Stage) -> dict[str, Any]:
    """The points to show and the side to see them from: the target on the right."""
    way = stage.target - stage.start
    angle = np.arctan2(way[1], way[0]) - np.deg2rad(90.0 + 22.0)
    height = np.deg2rad(24.0 if stage.geometry.dimensions == 3 else 38.0)
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
    low, high = stage.low, stage.high
    for x in multiples(low[0], high[0], 5.0 * stage.cell):
        place = np.array([x, low[1] - 0.25 * stage.cell, low[2]])
        labels.append(_label(f"{x:g} m", place, "tick", 0))
    return labels


def _label(text: str, place: Array, kind: str, side: int) -> dict[str, Any]:
    """A label above (side -1), on (0) or below (1) a place."""
    position = place.round(3).tolist()
    return {"text": text, "position": position, "kind": kind, "side": side}


def _remark(stage: Stage) -> str:
    """What has to be said for the picture to be read rightly."""
    name = stage.geometry.vehicle
    pale = "Pale: the other methods. " if len(stage.runs) > 1 else ""
    scale = f" It is drawn at 1:{stage.fraction}." if stage.fraction > 1 else ""
    outside = f"The {name}'s centre must stay outside the obstacles."
    return f"{pale}{outside}{scale}{_verdict(stage.runs[-1])}"


def _verdict(run: Run) -> str:
    """The audit's word on a run as a whole; nothing where there was none."""
    reasons = run.result.summary.get("reasons_against")
    if reasons is None:
        return ""
    if not reasons:
        return f" {run.label} (whole run): guaranteed, every promise kept."
    more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    return f" {run.label} (whole run): not guaranteed ({reasons[0]}{more})."


def _words(stage: Stage) -> tuple[str, str]:
    """The scenario's title, which its description starts with, and the rest of it."""
    scenario = stage.runs[-1].result.scenario
    title, _, rest = scenario.description.strip().partition("\n")
    return title.strip().rstrip(".") or scenario.name, " ".join(rest.split())


def _finite(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


def _rounded(values: ArrayLike) -> list[float]:
    return [float(f"{value:.4g}") for value in np.asarray(values)]


def _text(name: str) -> str:
    page = files("vcbf_drake.viz.replay") / "page" / name
    return page.read_text(encoding="utf-8")
