"""The Meshcat replay: one self-contained page for one or several methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcbf_drake.typed import tag_of
from vcbf_drake.viz.replay.page import page_data, whole_page
from vcbf_drake.viz.runs import Run, barrier_unit
from vcbf_drake.viz.stage import Stage, set_stage

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result


def write_replay(results: Sequence[Result], path: Path) -> Path:
    """Writes an HTML page that replays results side by side, with nothing to install.

    Args:
        results: Results of one scenario under one or several methods, or of several
            vehicles of one; of each vehicle the last one is drawn solid, the others as
            translucent ghosts.
        path: The page to write; its directory is made.

    Returns:
        The path.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    # Importing Meshcat takes time that programs without a replay need not spend.
    from vcbf_drake.viz.replay.scene import draw_stage, private_meshcat, record

    stage, meshcat = set_stage(results), private_meshcat()
    draw_stage(meshcat, stage)
    failures = {
        f"failure/{index}": run.failure.time
        for index, run in enumerate(stage.runs)
        if run.failure
    }
    rate = (len(stage.time) - 1) / stage.time[-1]
    page = record(meshcat, rate, stage.bodies, failures)
    return write_page(path, whole_page(page, stage_data(stage), **stage_words(stage)))


def write_page(path: Path, page: str) -> Path:
    """Writes a page, after making its directory; returns the path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(page.encode("utf-8"))
    return path


def stage_words(stage: Stage) -> dict[str, str]:
    """The text of a stage's card: the title, then the rest of the description."""
    scenario = stage.run.scenario
    title, _, rest = scenario.description.strip().partition("\n")
    name = tag_of(type(stage.run.vehicle)).removeprefix("!").lower()
    has_ghosts = len(stage.tasks) < len(stage.runs)
    remark = "Pale: the other methods. " if has_ghosts else ""
    one = len(stage.tasks) == 1
    remark += f"The {name}'s centre" if one else "The vehicles' centres"
    remark += " must stay outside the obstacles."
    if stage.fraction > 1:
        remark += f" It is drawn at 1:{stage.fraction}."
    return {
        "title": title.strip().rstrip(".") or scenario.name,
        "description": " ".join(rest.split()),
        "remark": remark + "".join(_verdict(r) for r in stage.runs if not r.ghost),
    }


def _verdict(run: Run) -> str:
    """The audit's word on a run as a whole; nothing where there was none."""
    reasons = run.result.summary.get("reasons_against")
    if reasons is None:
        return ""
    if not reasons:
        return f" {run.label} (whole run): guaranteed, every promise kept."
    more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    return f" {run.label} (whole run): not guaranteed ({reasons[0]}{more})."


def stage_data(stage: Stage, live: bool = False) -> dict[str, Any]:
    """The page's data of a stage; of a run that goes on, what it has at the start."""
    shown = [*zip(stage.runs, stage.paths, strict=True)]
    unit = barrier_unit(stage.run.scenario)
    return page_data(shown, stage.view, float(stage.time[-1]), unit, live)
