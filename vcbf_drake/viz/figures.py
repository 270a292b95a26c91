"""Every figure of one or several results, as PNG and SVG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcbf_drake.viz.feasible_set import telling_times
from vcbf_drake.viz.feasible_set_figure import feasible_set_figure
from vcbf_drake.viz.feasible_solid_figure import feasible_solid_figure
from vcbf_drake.viz.geometry import geometry_of
from vcbf_drake.viz.overview_figure import overview_figure
from vcbf_drake.viz.path_figure import path_figure
from vcbf_drake.viz.runs import label_runs
from vcbf_drake.viz.series_figures import (
    barrier_figure,
    disturbance_figure,
    input_figure,
    slack_figure,
    volume_figure,
)
from vcbf_drake.viz.style import figure_style, save_figure

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result


def write_figures(
    results: Sequence[Result], directory: Path, times: Sequence[float] | None = None
) -> list[Path]:
    """Writes every figure that results of one scenario have, each as PNG and SVG.

    Args:
        results: Results of one scenario under one or several methods, the one to bring
            out last.
        directory: Where to write; it is made.
        times: When to show the feasible sets [s]; by default 2 s, the tick before the
            first infeasible one, and that tick.

    Returns:
        The paths, in the order of writing.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    runs = label_runs(results)
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    when = telling_times(runs) if times is None else times
    paths: list[Path] = []

    def write(name: str, figure: Any) -> None:
        paths.extend(save_figure(figure, directory, name))

    with figure_style():
        write("overview", overview_figure(runs))
        write("paths", path_figure(runs))
        write("barriers", barrier_figure(runs))
        write("volume", volume_figure(runs))
        write("slack", slack_figure(runs))
        write("disturbance", disturbance_figure(runs))
        write("inputs", input_figure(runs))
        write("feasible_sets", feasible_set_figure(runs, when))
        if len(geometry_of(results[-1]).inputs) == 3:
            write("feasible_solids", feasible_solid_figure(runs, when))
    return paths
