"""The replay's page around Meshcat's own: card, clock, plots, and what they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import html
from importlib.resources import files
import json
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vcbf_drake.checks import Array
from vcbf_drake.viz.feasible_set import (
    FeasibleSet,
    feasible_set_of_tick,
    shadow,
    shown_inputs,
)
from vcbf_drake.viz.runs import Drawn
from vcbf_drake.viz.solids import hull
from vcbf_drake.viz.stage import View
from vcbf_drake.viz.style import BLUE, multiples

if TYPE_CHECKING:
    from vcbf_drake.simulation.sections import InputLimits

MAX_SAMPLES = 800  # A plot is a few hundred pixels wide.
MAX_SETS = 400
_UNSAFE_BELOW = "barrier", "volume"  # The range below 0 is shaded.
SCRIPTS = "plots.js", "choice.js", "scene.js", "player.js"
MESHCAT_TITLE = "<title>Drake MeshCat</title>"
PHONES = '<meta name="viewport" content="width=device-width, initial-scale=1">'
NO_ICON = '<link rel="icon" href="data:,">'  # Or the browser asks for one.


def whole_page(
    page: str,
    data: Mapping[str, Any],
    title: str,
    description: str = "",
    remark: str = "",
) -> str:
    """Meshcat's page with the card, the plots and the player over it.

    Args:
        page: Meshcat's page with its recording.
        data: The data of the scripts, JSON values only.
        title: The card's first line, and the page's title.
        description: The description of the page.
        remark: A remark that is needed to read the picture correctly.
    """
    # In JSON inside HTML only "<" could end the element early.
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    overlay = Template(_text("page.html")).substitute(
        title=html.escape(title),
        description=html.escape(description),
        remark=html.escape(remark),
        style=_text("page.css"),
        data=text.replace("<", "\\u003c"),
        script="\n".join(map(_text, SCRIPTS)),
    )
    head = f"{PHONES}{NO_ICON}<title>{html.escape(title)} - vcbf_drake</title>"
    head, tail = page.replace(MESHCAT_TITLE, head).rsplit("</body>", 1)
    return f"{head}{overlay}</body>{tail}"


def page_data(
    shown: Sequence[tuple[Drawn, Array]],
    view: View,
    duration: float,
    unit: str,
    live: bool = False,
    trails: Sequence[Array] = (),
) -> dict[str, Any]:
    """The data of the page's scripts; ``None`` where a number is missing.

    Args:
        shown: The runs, the one to bring out last, and where each one's label is at
            every frame, shape (F, 3) [m].
        view: The scene.
        duration: The duration of the motion [s].
        unit: The barriers' unit; empty where they have several.
        live: Whether more is to come: nobody knows of the slack yet.
        trails: The ways of others, shape (F, 3) each [m].
    """
    return {
        "duration": duration,
        "frames_per_second": (len(shown[-1][1]) - 1) / duration,
        "live": live,
        "runs": [_run_data(*each) for each in shown],
        "plots": _plots([run for run, _ in shown], unit, live),
        "camera": {
            "points": view.points.round(4).tolist(),
            "span": view.span,
            "direction": view.toward.round(6).tolist(),
        },
        "sizes": {"vehicle": view.rise, "marker": view.mark, "trail": view.trail},
        "trails": [{"color": BLUE, "path": each.round(4).tolist()} for each in trails],
        "labels": [_label(*each, "place", 1) for each in view.places] + _ticks(view),
        "round": view.few,
    }


def _run_data(run: Drawn, path: Array) -> dict[str, Any]:
    """The page's data of a run."""
    names = ("label", "color", "ghost", "inputs")
    data: dict[str, Any] = {name: getattr(run, name) for name in names}
    data["dashes"] = " ".join(map(str, run.dashes))
    if run.limits is not None:
        pairs = zip(run.limits.lower, run.limits.upper, strict=True)
        data["limits"] = [[*p] if np.isfinite(p).all() else None for p in pairs]
        data["axes"] = _choice_axes(run, run.limits)
    return data | series_data(run, path)


def series_data(run: Drawn, path: Array) -> dict[str, Any]:
    """The time series of a run; its path has a position for every frame."""
    kept, log = _kept(len(run.time), MAX_SAMPLES), run.log
    data: dict[str, Any] = {
        "events": [vars(event) for event in run.events],
        "path": path.round(4).tolist(),
        "time": _finite(run.time[kept]),
    }
    if run.limits is None:
        return data
    inputs = np.asarray(log["input"], dtype=float)[kept]
    return data | {
        "barrier": _finite(run.least_barrier[kept]),
        "volume": _finite(np.asarray(log["volume"], dtype=float)[kept]),
        "slack": _finite(np.asarray(log["slack"], dtype=float)[kept]),
        **{f"input{k}": _finite(each) for k, each in enumerate(inputs.T)},
        "sets": _sets(run, run.limits),
    }


def _plots(shown: Sequence[Drawn], unit: str, live: bool) -> list[dict[str, Any]]:
    """The plots: barrier, volume, and the slack, or the inputs where it is nothing.

    Of methods without a volume row there is no volume.
    """
    if shown[-1].limits is None:
        return []
    barrier = f"Barrier min h [{unit}]" if unit else "Barrier min h"
    slack = [np.asarray(run.log["slack"], float) for run in shown]
    if any(np.any(np.abs(each[np.isfinite(each)]) > 1e-9) for each in slack):
        third = "Slack δ [-]", "how far the volume row gave way", "slack"
    else:
        note = "and limits" if live else "and limits; the slack is 0 throughout"
        third = "Inputs", note, "input"
    volume = "Volume barrier Vᵥ [-]", "room left for inputs", "volume"
    return [
        {"title": title, "note": note, "key": key, "below": key in _UNSAFE_BELOW}
        for title, note, key in (
            (barrier, "unsafe below 0", "barrier"),
            *([volume] if any(run.has_volume for run in shown) else []),
            third,
        )
    ]


def _choice_axes(run: Drawn, limits: InputLimits) -> dict[str, Any]:
    """The plane of the first two inputs, in which the feasible sets are shown."""
    names, (low, high) = list(run.inputs), shown_inputs(run.log, limits)
    if len(names) == 1:  # A band, for the eye.
        low, high, names = np.append(low, -1.0), np.append(high, 1.0), [*names, ""]
    note = "; their shadow on two inputs" if len(names) > 2 else ""
    note += f"; the other {len(names) - 2} not shown" if len(names) > 3 else ""
    ends = {"low": _rounded(low[:2]), "high": _rounded(high[:2])}
    return {"names": names[:2], **ends, "note": note}


def _sets(run: Drawn, limits: InputLimits) -> dict[str, list[Any]]:
    """The feasible sets of a run over time, as shadows on the first two inputs.

    An ellipse is its centre and the lower triangle that takes the unit circle to it.
    """
    kept = _kept(len(run.time), MAX_SETS)
    sets = [feasible_set_of_tick(run.log, limits, int(tick)) for tick in kept]
    # The corners one coordinate after the other; none when the set is empty.
    corners = [hull(each.corners[:, :2]).ravel() for each in sets]
    return {
        "time": _finite(run.time[kept]),
        "outline": [_rounded(each) for each in corners],
        "eased": [int(each.empty and each.has_choice) for each in sets],
        "ellipse": [None if each.empty else _ellipse(each) for each in sets],
        "reference": [_rounded(each.reference[:2]) for each in sets],
        "input": [_rounded(each.input[:2]) for each in sets],
    }


def _ellipse(feasible: FeasibleSet) -> list[float] | None:
    if not np.isfinite(feasible.shape).all():
        return None
    triangle = shadow(feasible.shape)[np.tril_indices(2)]
    return _rounded([*feasible.center[:2], *triangle])


def _kept(ticks: int, most: int) -> NDArray[np.int_]:
    """Which of so many ticks are shown, the first and the last included."""
    kept: NDArray[np.int_] = np.unique(
        np.linspace(0, ticks - 1, min(ticks, most)).astype(int)
    )
    return kept


def _ticks(view: View) -> list[dict[str, Any]]:
    """Numbers along the floor's edge that is nearer to the eye."""
    low, high, cell = view.low, view.high, view.cell
    edge = low[1] - 0.25 * cell if view.toward[1] < 0.0 else high[1] + 0.25 * cell
    return [
        _label(f"{x:g} m", np.array([x, edge, low[2]]), "tick", 0)
        for x in multiples(low[0], high[0], 5.0 * cell)
    ]


def _label(text: str, place: Array, kind: str, side: int) -> dict[str, Any]:
    """A label above (side -1), on (0) or below (1) a place."""
    position = place.round(3).tolist()
    return {"text": text, "position": position, "kind": kind, "side": side}


def _finite(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


def _rounded(values: ArrayLike) -> list[float] | None:
    """Numbers in four digits; nothing where one of them is not finite."""
    numbers = np.asarray(values)
    finite = np.isfinite(numbers).all()
    return [float(f"{number:.4g}") for number in numbers] if finite else None


def _text(name: str) -> str:
    page = files("vcbf_drake.viz.replay") / "page" / name
    return page.read_text(encoding="utf-8")
