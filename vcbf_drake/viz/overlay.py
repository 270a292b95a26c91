"""The page over the replay: title, legend, clock, plots, and the data they show."""

from __future__ import annotations

import html
from importlib.resources import files
import json
from string import Template
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.runs import Run
from vcbf_drake.viz.stage import Motion, Stage, multiples

MAX_SAMPLES = 800  # A plot is a few hundred pixels wide.


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
    return Template(_text("overlay.html")).substitute(
        title=html.escape(title),
        description=html.escape(description),
        remark=html.escape(_remark(stage)),
        style=_text("overlay.css"),
        data=data.replace("<", "\\u003c"),
        script="\n".join(map(_text, ("plots.js", "scene.js", "player.js"))),
    )


def page_title(stage: Stage) -> str:
    """The page's title, as HTML."""
    return html.escape(f"{_words(stage)[0]} - vcbf_drake")


def overlay_data(stage: Stage) -> dict[str, Any]:
    """The data of the page: JSON values only, ``None`` where a number is missing."""
    squared = stage.runs[-1].result.scenario.barrier.form == "squared"
    return {
        "duration": stage.duration,
        "frames_per_second": stage.frames_per_second,
        "runs": [
            _run_data(run, motion)
            for run, motion in zip(stage.runs, stage.motions, strict=True)
        ],
        "plots": [
            {
                "key": "barrier",
                "title": f"Barrier min h [{'m²' if squared else 'm'}]",
                "note": "unsafe below 0",
                "below": True,
            },
            {
                "key": "volume",
                "title": "Volume barrier Vᵥ [-]",
                "note": "room left for inputs",
                "below": True,
            },
            {
                "key": "slack",
                "title": "Slack δ [-]",
                "note": "how far the volume row gave way",
                "below": False,
            },
        ],
        "camera": _camera(stage),
        "sizes": {
            "vehicle": stage.geometry.rise / stage.fraction,
            "marker": stage.mark,
        },
        "labels": _labels(stage),
    }


def _run_data(run: Run, motion: Motion) -> dict[str, Any]:
    ticks = len(run.time)
    kept = np.unique(np.linspace(0, ticks - 1, min(ticks, MAX_SAMPLES)).astype(int))
    log = run.result.log
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
    }


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
    """What the audit says of a run; nothing where there was none."""
    reasons = run.result.summary.get("reasons_against")
    if reasons is None:
        return ""
    if not reasons:
        return f" {run.label}: guaranteed, every promise kept."
    more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    return f" {run.label}: not guaranteed ({reasons[0]}{more})."


def _words(stage: Stage) -> tuple[str, str]:
    """The scenario's title, which its description starts with, and the rest of it."""
    scenario = stage.runs[-1].result.scenario
    title, _, rest = scenario.description.strip().partition("\n")
    return title.strip().rstrip(".") or scenario.name, " ".join(rest.split())


def _finite(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


def _text(name: str) -> str:
    page = files("vcbf_drake.viz") / "overlay_page" / name
    return page.read_text(encoding="utf-8")
