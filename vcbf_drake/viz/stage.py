"""Everything a replay shows, sampled at its frames, before it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RigidTransform

from vcbf_drake.checks import Array
from vcbf_drake.viz.geometry import (
    Geometry,
    Sphere,
    drawn_fraction,
    geometry_of,
    spheres_of,
)
from vcbf_drake.viz.runs import Run, label_runs
from vcbf_drake.viz.solids import Solid, solids_of

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result

MAX_FRAMES = 300  # A page should stay small; the browser fills in between.


@dataclass(frozen=True)
class Motion:
    """A run sampled at the replay's frames.

    Attributes:
        time: The frames' times, shape (F,) [s].
        position: The vehicle's place, shape (F, 3) [m]; it rests once the run is over.
        poses: The poses of the vehicle's bodies at each, by their names.
    """

    time: Array
    position: Array
    poses: list[dict[str, RigidTransform]]

    def position_at(self, time: float) -> Array:
        """The vehicle's place at a time [s], shape (3,) [m]."""
        return np.array([np.interp(time, self.time, axis) for axis in self.position.T])


@dataclass(frozen=True)
class Stage:
    """What a replay shows.

    Attributes:
        runs: The runs, the one to bring out last.
        motions: One a run.
        geometry: The plant's geometry.
        spheres: The obstacles.
        target: The place to reach, shape (3,) [m].
        low: The least corner of the floor, shape (3,) [m].
        high: The greatest corner of what is shown, shape (3,) [m].
        fraction: The vehicle is drawn at the scale 1 to this.
    """

    runs: list[Run]
    motions: list[Motion]
    geometry: Geometry
    spheres: list[Sphere]
    target: Array
    low: Array
    high: Array
    fraction: int

    @property
    def duration(self) -> float:
        """The time of the last frame [s]."""
        return float(self.motions[-1].time[-1])

    @property
    def frames_per_second(self) -> float:
        """How many frames a second the motions have."""
        return 1.0 / float(self.motions[-1].time[1])

    @property
    def start(self) -> Array:
        """Where the run to bring out starts, shape (3,) [m]."""
        start: Array = self.motions[-1].position[0]
        return start

    @property
    def span(self) -> float:
        """The length of the way [m], the measure of everything drawn for the eye."""
        return max(0.5, float(np.linalg.norm(self.target - self.start)))

    @property
    def mark(self) -> float:
        """The radius of the balls that mark places [m]."""
        return 0.009 * self.span

    @property
    def reach(self) -> float:
        """Half the vehicle's drawn length [m]."""
        return 0.5 * self.geometry.length / self.fraction

    @property
    def outline(self) -> Array:
        """The points that a view of the whole has to contain, shape (k, 3) [m]."""
        low, high = self.low, self.high
        floor = [[x, y, low[2]] for x in (low[0], high[0]) for y in (low[1], high[1])]
        up = np.array([0.0, 0.0, 1.0])
        tops = [sphere.center + sphere.reach * up for sphere in self.spheres]
        rise = up * self.geometry.rise / self.fraction
        paths = [motion.position[::5] + rise for motion in self.motions]
        return np.vstack([*paths, self.target, floor, *tops])

    @property
    def cell(self) -> float:
        """The distance between the floor's lines [m]."""
        return cell_size(self.span)


def set_stage(results: Sequence[Result]) -> Stage:
    """Collects what a replay of these results shows.

    Args:
        results: Results of one scenario, the one to bring out last.

    Raises:
        ValueError: There is no result, or its plant cannot be drawn.
    """
    runs = label_runs(results)
    geometry, spheres = geometry_of(results[-1]), spheres_of(results[-1])
    target = geometry.point(results[-1].scenario.target)
    duration = max(float(run.time[-1]) for run in runs)
    motions = [_motion(run, geometry, duration) for run in runs]
    fraction = drawn_fraction(geometry, spheres)
    solids = solids_of(results[-1].scenario, 0.1)
    low, high = _extent(motions, spheres, solids, target, geometry)
    return Stage(runs, motions, geometry, spheres, target, low, high, fraction)


def cell_size(span: float) -> float:
    """The distance between the floor's lines for a way of a length [m]."""
    return 1.0 if span > 4.0 else 0.5 if span > 2.0 else 0.1


def multiples(low: float, high: float, step: float) -> Array:
    """The multiples of a step between two bounds, shape (k,)."""
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return np.arange(first, last + 1.0) * step + 0.0  # Adding 0 turns -0 into 0.


def _motion(run: Run, geometry: Geometry, duration: float) -> Motion:
    state = np.array(run.result.log["state"], dtype=float)
    rate = 10.0 if 10.0 * duration <= MAX_FRAMES else max(1.0, MAX_FRAMES // duration)
    # The last frame is not before the end, where the vehicle rests.
    frames = max(int(np.ceil(duration * rate - 1e-9)), 1) + 1
    time = np.arange(frames) / rate
    angles = list(geometry.angles)
    state[:, angles] = np.unwrap(state[:, angles], axis=0)
    shown = np.stack([np.interp(time, run.time, each) for each in state.T], axis=1)
    poses = [geometry.robot.poses(each) for each in shown]
    return Motion(time, geometry.position(shown), poses)


def _extent(
    motions: Sequence[Motion],
    spheres: Sequence[Sphere],
    solids: Sequence[Solid],
    target: Array,
    geometry: Geometry,
) -> tuple[Array, Array]:
    """The corners of the box around everything, with a floor below it."""
    points = np.vstack([motion.position for motion in motions] + [target])
    ends = [motions[-1].time[0], motions[-1].time[-1]]
    for sphere in spheres:
        for center in map(sphere.center_at, ends):
            points = np.vstack([points, center - sphere.reach, center + sphere.reach])
    for solid in solids:
        moved = [solid.surface + time * solid.velocity for time in ends]
        points = np.vstack([points, *moved])
    low, high = points.min(axis=0), points.max(axis=0)
    border = 0.06 * float(np.linalg.norm(high - low))
    if geometry.dimensions == 2:
        low[2], high[2] = 0.0, 0.0
    else:
        low[2] -= border
    # A floor much narrower than it is long would look like a plank.
    narrow = 0.5 * np.maximum(0.36 * (high - low)[1::-1] - (high - low)[:2], 0.0)
    low[:2] -= border + narrow
    high[:2] += border + narrow
    return low, high
