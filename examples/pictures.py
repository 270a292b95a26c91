"""Pictures of the examples: paths, and below them the barriers over time."""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Circle

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")


def draw(
    name, paths, discs, time, h, top=1.0, unit="m", axes="xy", shapes=(), tall=False
):
    """Writes out/examples/NAME.png and returns its path.

    Args:
        name: The picture's name.
        paths: One array of positions a vehicle, shape (T, 2) [m].
        discs: Obstacles as (center, radius, style), style for matplotlib's Circle.
        time: Shape (T,) [s].
        h: The barriers' values, shape (T, N).
        top: The largest h that is shown.
        unit: The unit of h.
        axes: The names of the two coordinates that are shown.
        shapes: More patches of matplotlib's to show.
        tall: Whether the paths go beside the barriers, not above them.
    """
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    above, below = (
        figure.subplots(1, 2) if tall else figure.subplots(2, height_ratios=[2, 1])
    )
    for center, radius, style in discs:
        above.add_patch(Circle(center[:2], radius, **{"lw": 0.8, **style}))
    for shape in shapes:
        above.add_patch(shape)
    for xy, color in zip(paths, COLORS, strict=False):
        above.plot(*xy.T, color=color)
        above.plot(*xy[0], "o", color=color, mfc="white")
        above.plot(*xy[-1], "o", color=color)
    above.set(aspect="equal", xlabel=f"{axes[0]} [m]", ylabel=f"{axes[1]} [m]")
    below.axhline(0.0, color="black", lw=0.6)
    for values, color in zip(h.T, COLORS, strict=False):
        below.plot(time, values, color=color)
    below.set(xlabel="time [s]", ylabel=f"h [{unit}]", ylim=(-0.06 * top, top))
    path = Path("out/examples") / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return path
