"""Everything a replay shows, sampled at its frames, before it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RigidTransform

from vcbf_drake.checks import Array
from vcbf_drake.plants.shapes import Part, bounding_box, of_body
from vcbf_drake.viz.runs import Run, label_runs
from vcbf_drake.viz.solids import Solid, in_space, solids_of, walls_of
from vcbf_drake.viz.style import SHELL

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result
    from vcbf_drake.simulation.scenario import Scenario

MAX_FRAMES = 300  # A page should stay small; the browser fills in between.


@dataclass(frozen=True)
class View:
    """The view of the scene for a camera and the labels.

    Attributes:
        points: The points that a view of the whole contains, shape (k, 3) [m].
        low: The least corner of the floor, shape (3,) [m].
        high: The greatest corner of what is shown, shape (3,) [m].
        span: The measure of everything drawn for the eye [m].
        toward: The direction of the eye, shape (3,).
        rise: The height of vehicles above their positions [m].
        places: Named ones, shape (3,) each [m].
        few: Whether there are so few things that balls may be finer than Meshcat's.
    """

    points: Array
    low: Array
    high: Array
    span: float
    toward: Array
    rise: float
    places: Sequence[tuple[str, Array]]
    few: bool

    @property
    def mark(self) -> float:
        """The radius of the balls that mark places [m]."""
        return 0.009 * self.span

    @property
    def trail(self) -> float:
        """The radius of the tubes that are drawn along ways [m]."""
        return 0.0022 * self.span

    @property
    def cell(self) -> float:
        """The distance between the floor's lines [m]."""
        return 1.0 if self.span > 4.0 else 0.5 if self.span > 2.0 else 0.1


@dataclass(frozen=True)
class Moving:
    """A rigid body and how it moves.

    Attributes:
        path: The path in Meshcat's tree.
        parts: Its pieces, in its own frame.
        times: Times between which it goes straight on, or nearly, shape (F,) [s].
        poses: The poses of its frame in the world at these times.
        scale: The scale at which its parts are drawn.
    """

    path: str
    parts: Sequence[Part]
    times: Array
    poses: Sequence[RigidTransform]
    scale: float = 1.0

    @property
    def moves(self) -> bool:
        """Whether it moves at all."""
        return not all(each.IsExactlyEqualTo(self.poses[0]) for each in self.poses)

    @property
    def reached(self) -> Array:
        """The corners of boxes that hold it, at some of the frames, (k, 3) [m]."""
        box = np.array([*product(*zip(*bounding_box(self.parts), strict=True))])
        some = [*self.poses[:: max(len(self.poses) // 20, 1)], self.poses[-1]]
        return np.vstack([(pose @ box.T).T for pose in some])


@dataclass(frozen=True)
class Stage:
    """The content of a scenario's replay.

    Attributes:
        runs: The runs, the one to bring out last.
        time: The frames' times, shape (F,) [s].
        paths: The vehicle's position in each run at every frame, shape (F, 3) [m]; it
            rests once the run is over.
        tasks: The name, the start and the target of each vehicle that is no ghost,
            shape (3,) [m].
        solids: The obstacles.
        bodies: Everything that stands or moves: vehicles, obstacles, walls.
        fraction: Vehicles are drawn at the scale 1 to this.
        view: The scene around them.
    """

    runs: Sequence[Run]
    time: Array
    paths: Sequence[Array]
    tasks: Sequence[tuple[str, Array, Array]]
    solids: Sequence[Solid]
    bodies: Sequence[Moving]
    fraction: int
    view: View

    @property
    def run(self) -> Run:
        """The run to bring out."""
        return self.runs[-1]


def set_stage(results: Sequence[Result]) -> Stage:
    """Collects the content of a replay of these results.

    Args:
        results: Results of one scenario, the one to bring out last.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    runs = label_runs(results)
    time = _frames(max(float(run.time[-1]) for run in runs))
    run, start = runs[-1], runs[-1].path[0]
    span = max(0.5, float(np.linalg.norm(run.target - start)))
    solids = solids_of(run.scenario, 0.04 * span)
    fraction = _fraction(run.vehicle.length, solids)
    paths, bodies, reached = list[Array](), list[Moving](), list[Array]()
    for index, each in enumerate(runs):
        states = _at_frames(each, time)
        paths.append(in_space(each.vehicle.positions(states)))
        own = _vehicle(index, each, time, states, 1.0 / fraction)
        bodies += own
        if len(own) > 1:  # Of one body, the position and its height are all.
            reached += [body.reached for body in own]
    obstacles = _obstacles(solids, float(time[-1]))
    around = [*(each.target for each in runs), *(each.reached for each in obstacles)]
    everything = np.vstack([*reached, *paths, *around])
    low, high = _extent(everything, run.is_flat, stands=bool(reached))
    _, top = bounding_box(of_body(run.vehicle.geometry("#000000")))
    rise = np.array([0.0, 0.0, float(top[2]) / fraction])
    floor = [[x, y, low[2]] for x in (low[0], high[0]) for y in (low[1], high[1])]
    tops = np.reshape(
        [max(each.surface, key=lambda point: point[2]) for each in solids], (-1, 3)
    )
    # Of a tower the part beside the ways is enough: with all of it they are tiny.
    ceiling = max(float(path[:, 2].max()) for path in paths) + 0.5 * span
    tops[:, 2] = np.minimum(tops[:, 2], ceiling)
    seen = [*reached, *(path[::5] + rise for path in paths), floor]
    angle = np.arctan2(*(run.target - start)[1::-1]) - np.deg2rad(90.0 + 22.0)
    steep = np.tan(np.deg2rad(38.0 if run.is_flat else 24.0))
    tasks = [(r.name, r.path[0], r.target) for r in runs if not r.ghost]
    view = View(
        points=np.vstack([*seen, *(each.target for each in runs), *tops]),
        low=low,
        high=high,
        span=span,
        toward=np.array([np.cos(angle), np.sin(angle), steep]),
        rise=rise[2],
        places=[
            (f"{word} {name}".strip(), place)
            for name, *ends in tasks
            for word, place in zip(("start", "target"), ends, strict=True)
        ],
        few=len(solids) < 100,
    )
    bodies += obstacles + _walls(run.scenario, view)
    return Stage(runs, time, paths, tasks, solids, bodies, fraction, view)


def body_path(index: int, body: str) -> str:
    """The path of a body of a run's vehicle in Meshcat's tree."""
    return f"vehicle/{index}/{body or 'point'}"


def _fraction(length: float, solids: Sequence[Solid]) -> int:
    """The whole number k such that a vehicle of a length is drawn at the scale 1:k.

    The barriers guard a point. Where the obstacles are smaller than the vehicle that
    carries it, its true size would hide them, and it is drawn smaller.
    """
    widths = [np.ptp(solid.surface[:, :2], axis=0).min() for solid in solids]
    least = 0.5 * float(min(widths, default=np.inf))
    return max(1, int(np.ceil(0.5 * length / (0.75 * least) - 1e-6)))


def _frames(duration: float) -> Array:
    """The times of a replay's frames [s]; the last is not before the end."""
    rate = 10.0 if 10.0 * duration <= MAX_FRAMES else max(1.0, MAX_FRAMES // duration)
    return np.arange(max(int(np.ceil(duration * rate - 1e-9)), 1) + 1) / rate


def _at_frames(run: Run, time: Array) -> Array:
    """The states of a run at frames, shape (F, n)."""
    state, angles = np.array(run.log["state"], dtype=float), list(run.channels.angles)
    state[:, angles] = np.unwrap(state[:, angles], axis=0)
    return np.stack([np.interp(time, run.time, each) for each in state.T], axis=1)


def _vehicle(
    index: int, run: Run, time: Array, states: Array, scale: float
) -> list[Moving]:
    """The bodies of a run's vehicle."""
    poses, parts = [*map(run.vehicle.poses, states)], run.vehicle.geometry(run.color)
    bodies = []
    for name in poses[0]:
        path, own = body_path(index, name), of_body(parts, name)
        bodies.append(Moving(path, own, time, [p[name] for p in poses], scale))
    return bodies


def _obstacles(solids: Sequence[Solid], duration: float) -> list[Moving]:
    """The obstacles, and around each the distance that has to be kept."""
    bodies = []
    for index, solid in enumerate(solids):
        parts = [each for each in (solid.body, solid.keep_out) if each is not None]
        times = solid.key_times(duration)
        poses = [RigidTransform(solid.offset_at(time)) for time in times]
        bodies.append(Moving(f"obstacles/{index}", parts, times, poses))
    return bodies


def _walls(scenario: Scenario, view: View) -> list[Moving]:
    """The walls, and before each the distance that has to be kept."""
    middle, size = 0.5 * (view.low + view.high), 1.2 * view.span
    bodies = []
    for index, wall in enumerate(walls_of(scenario)):
        parts = []
        for name, thick, color in (
            ("body", -0.004 * size, SHELL + "4c"),  # More would throw a shadow.
            ("keep_out", wall.margin, SHELL + "26"),
        ):
            if thick != 0.0:
                slab, pose = wall.slab(middle, size, 0.06 * view.span, thick)
                parts.append(Part(name, slab, color, pose))
        body = Moving(f"walls/{index}", parts, np.zeros(1), [RigidTransform()])
        bodies.append(body)
    return bodies


def _extent(points: Array, is_flat: bool, stands: bool) -> tuple[Array, Array]:
    """The corners of the box around points, shape (k, 3), with a floor below it."""
    low, high = points.min(axis=0), points.max(axis=0)
    border = 0.06 * float(np.linalg.norm(high - low))
    if is_flat:
        low[2], high[2] = 0.0, 0.0
    elif not stands:  # Bodies on joints do.
        low[2] -= border
    # A floor much narrower than it is long would look like a plank.
    narrow = 0.5 * np.maximum(0.36 * (high - low)[1::-1] - (high - low)[:2], 0.0)
    low[:2] -= border + narrow
    high[:2] += border + narrow
    return low, high
