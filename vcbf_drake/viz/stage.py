"""Everything a replay shows, sampled at its frames, before it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RigidTransform

from vcbf_drake.checks import Array
from vcbf_drake.plants.shapes import bounding_box, of_body
from vcbf_drake.viz.runs import Run, label_runs
from vcbf_drake.viz.solids import Solid, in_space, solids_of

if TYPE_CHECKING:
    from vcbf_drake.plants.vehicle import Vehicle
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
        solids: The obstacles.
        low: The least corner of the floor, shape (3,) [m].
        high: The greatest corner of what is shown, shape (3,) [m].
        bodies: What a robot of several bodies reaches, shape (k, 3) [m].
        fraction: The vehicle is drawn at the scale 1 to this.
        rise: How far it is drawn above its position [m].
    """

    runs: list[Run]
    motions: list[Motion]
    solids: list[Solid]
    low: Array
    high: Array
    bodies: Array
    fraction: int
    rise: float

    @property
    def run(self) -> Run:
        """The run to bring out."""
        return self.runs[-1]

    @property
    def target(self) -> Array:
        """The place to reach, shape (3,) [m]."""
        return self.run.target

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
        """Half the vehicle's drawn length [m]; without one, a few marks."""
        return 0.5 * self.run.vehicle.length / self.fraction or 3.0 * self.mark

    @property
    def outline(self) -> Array:
        """The points that a view of the whole has to contain, shape (k, 3) [m]."""
        low, high = self.low, self.high
        floor = [[x, y, low[2]] for x in (low[0], high[0]) for y in (low[1], high[1])]
        tops = [_highest(solid.whole.surface) for solid in self.solids]
        up = np.array([0.0, 0.0, self.rise])
        paths = [motion.position[::5] + up for motion in self.motions]
        return np.vstack([*paths, self.bodies, self.target, floor, *tops])

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
    duration = max(float(run.time[-1]) for run in runs)
    motions = [_motion(run, duration) for run in runs]
    vehicle, span = runs[-1].vehicle, runs[-1].target - motions[-1].position[0]
    height = 0.04 * max(0.5, float(np.linalg.norm(span)))
    solids = solids_of(results[-1].scenario, height)
    fraction = _fraction(vehicle.length, solids)
    bodies = np.vstack([_body_corners(vehicle, motion) for motion in motions])
    low, high = _extent(motions, solids, runs[-1], bodies)
    _, top = bounding_box(of_body(vehicle.geometry("#000000")))
    rise = float(top[2]) / fraction
    return Stage(runs, motions, solids, low, high, bodies, fraction, rise)


def cell_size(span: float) -> float:
    """The distance between the floor's lines for a way of a length [m]."""
    return 1.0 if span > 4.0 else 0.5 if span > 2.0 else 0.1


def multiples(low: float, high: float, step: float) -> Array:
    """The multiples of a step between two bounds, shape (k,)."""
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return np.arange(first, last + 1.0) * step + 0.0  # Adding 0 turns -0 into 0.


def _fraction(length: float, solids: Sequence[Solid]) -> int:
    """The whole number k such that a vehicle of a length is drawn at the scale 1:k.

    The barriers guard a point. Where the obstacles are smaller than the vehicle that
    carries it, its true size would hide them, and it is drawn smaller.
    """
    widths = [np.ptp(solid.whole.surface[:, :2], axis=0).min() for solid in solids]
    least = 0.5 * float(min(widths, default=np.inf))
    return max(1, int(np.ceil(0.5 * length / (0.75 * least) - 1e-6)))


def _motion(run: Run, duration: float) -> Motion:
    state = np.array(run.result.log["state"], dtype=float)
    rate = 10.0 if 10.0 * duration <= MAX_FRAMES else max(1.0, MAX_FRAMES // duration)
    # The last frame is not before the end, where the vehicle rests.
    frames = max(int(np.ceil(duration * rate - 1e-9)), 1) + 1
    time = np.arange(frames) / rate
    angles = list(run.channels.angles)
    state[:, angles] = np.unwrap(state[:, angles], axis=0)
    shown = np.stack([np.interp(time, run.time, each) for each in state.T], axis=1)
    poses = [run.vehicle.poses(each) for each in shown]
    return Motion(time, in_space(run.vehicle.positions(shown)), poses)


def _highest(points: Array) -> Array:
    top: Array = points[np.argmax(points[:, 2])]
    return top


def _body_corners(vehicle: Vehicle, motion: Motion) -> Array:
    """The corners of what the bodies of a robot with several reach, (k, 3) [m]."""
    parts = vehicle.geometry("#000000")
    some = motion.poses[:: max(len(motion.poses) // 20, 1)]
    names = [] if len(some[0]) == 1 else [*some[0]]
    corners = {
        name: np.array(
            [*product(*zip(*bounding_box(of_body(parts, name)), strict=True))]
        )
        for name in names
    }
    found = [(poses[name] @ corners[name].T).T for poses in some for name in names]
    return np.vstack([np.empty((0, 3)), *found])


def _extent(
    motions: Sequence[Motion], solids: Sequence[Solid], run: Run, bodies: Array
) -> tuple[Array, Array]:
    """The corners of the box around everything, with a floor below it."""
    found = [run.target, bodies, *(motion.position for motion in motions)]
    for solid in solids:
        places = map(solid.offset_at, solid.key_times(motions[-1].time[-1]))
        found += [solid.whole.surface + offset for offset in places]
    points = np.vstack(found)
    low, high = points.min(axis=0), points.max(axis=0)
    border = 0.06 * float(np.linalg.norm(high - low))
    if run.is_flat:
        low[2], high[2] = 0.0, 0.0
    else:
        low[2] -= border
    if len(bodies):  # Bodies on joints stand on something.
        low[2] += border
    # A floor much narrower than it is long would look like a plank.
    narrow = 0.5 * np.maximum(0.36 * (high - low)[1::-1] - (high - low)[:2], 0.0)
    low[:2] -= border + narrow
    high[:2] += border + narrow
    return low, high
