"""One look for every picture: a colour per method, fonts, and reproducible bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vcbf_drake.checks import Array

Style = dict[str, Any]  # The keyword arguments of something drawn.
# Of matplotlib, whose import takes time that most programs need not spend.
Figure: TypeAlias = Any
Axes: TypeAlias = Any

FONT = "DejaVu Sans"
PAGE_WIDTH = 7.0  # Two columns of a paper [inch].

INK = "#1f2733"
MUTED = "#6b7685"
GRID = "#e3e7ec"
OBSTACLE = "#9aa5b4"
BLUE = "#0072b2"
SHELL = "#5f7fa8"  # The distance to keep.
START = "#4a5563"
TARGET = "#1a9850"
ALARM = "#c8102e"


@dataclass(frozen=True)
class MethodStyle:
    """The name and the look of one method in every picture.

    Attributes:
        label: The name people read.
        color: A hexadecimal colour, told apart by colour-blind eyes.
        dashes: On and off lengths [points]; empty for a solid line.
    """

    label: str
    color: str
    dashes: tuple[float, ...]


# Okabe and Ito's palette; the dashes tell the methods apart in grey print as well.
METHOD_STYLES = {
    "cbf-qp": MethodStyle("CBF-QP", "#56606e", (1.2, 1.4)),
    "robust-cbf-qp": MethodStyle("Robust CBF-QP", "#009e73", (6.0, 1.6, 1.2, 1.6)),
    "wang-xu-dob-cbf-qp": MethodStyle("Wang-Xu DOB-CBF-QP", "#cc79a7", (3.0, 1.4)),
    "vcbf-qp": MethodStyle("VCBF-QP", "#e69f00", (8.0, 2.0)),
    "dob-cbf-qp": MethodStyle("DOB-CBF-QP", "#d55e00", (5.0, 1.6)),
    "dob-vcbf-qp": MethodStyle("DOB-VCBF-QP", BLUE, ()),
    "optimal-decay": MethodStyle("Optimal decay", "#56b4e9", (9.0, 1.6, 3.0, 1.6)),
    "backup": MethodStyle("Backup CBF-QP", "#117733", (1.6, 1.6)),
}

# Of several vehicles in one scenario.
VEHICLE_COLORS = BLUE, "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56606e"


@contextmanager
def figure_style() -> Iterator[None]:
    """Draws with this package's look, independent of the user's settings."""
    from matplotlib import style

    sheet = Path(__file__).with_name("figures.mplstyle")
    with style.context(sheet, after_reset=True):
        yield


def new_figure(width: float, height: float) -> Figure:
    """A figure of a size [inch] without a window: no display or backend is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def legend_in_a_row(labels: Sequence[str]) -> Style:
    """The options of a legend as wide as the page; long labels share fewer columns."""
    longest = max(map(len, labels), default=0)
    ncols = max(min(len(labels), 100 // (longest + 8)), 1)
    if ncols == len(labels) <= 4:
        return {"ncols": ncols}
    ncols = -(-len(labels) // -(-len(labels) // ncols))  # Rows of equal length.
    return {"ncols": ncols, "fontsize": 7.5, "columnspacing": 1.1, "handlelength": 2.2}


def legend_above(axes: Axes) -> None:
    """Puts a legend above axes that are as wide as the page."""
    options = legend_in_a_row(axes.get_legend_handles_labels()[1])
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), borderpad=0.1, **options)


def multiples(low: float, high: float, step: float) -> Array:
    """The multiples of a step between two bounds, shape (k,)."""
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return np.arange(first, last + 1.0) * step + 0.0  # Adding 0 turns -0 into 0.


def save_figure(figure: Figure, directory: Path, name: str) -> list[Path]:
    """Writes a figure as NAME.png and NAME.svg, the same bytes every time."""
    png, svg = directory / f"{name}.png", directory / f"{name}.svg"
    figure.savefig(png, metadata={"Software": None})
    figure.set_layout_engine("none")  # Everything has its place; finding it is slow.
    figure.savefig(svg, metadata={"Date": None, "Creator": None})
    return [png, svg]
