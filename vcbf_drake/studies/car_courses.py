"""Random courses for the car: a gate of two discs across its way, and more discs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vcbf_drake.plants import CarParameters

# The approach gains k_p of the paper's second car experiment [1/s].
APPROACH_GAINS = (0.2, 0.4, 0.6, 0.8, 1.0)

# What a course draws uniformly, and from where. All ours: the paper prints no layout.
CAR_COURSE_RANGES: dict[str, tuple[float, float]] = {
    "force limit [N]": (0.4, 1.2),
    "turn rate limit [rad/s]": (0.3, 1.2),
    "push over force limit": (0.1, 0.4),
    "disc radius [m]": (0.3, 0.5),
    "gate width [m]": (0.2, 0.8),
    "gate along the way [m]": (1.3, 3.7),
    "gate beside the way [m]": (-0.6, 0.6),
    "gate turned by [rad]": (-0.5, 0.5),
    "other disc along the way [m]": (1.0, 4.0),
    "other disc beside the way [m]": (-1.2, 1.2),
}
# Of these a course takes one, each as likely as the others.
OTHER_DISCS = (0, 1, 2)
BARRIER_GAINS = ((4.0, 3.0), (6.0, 8.0), (10.0, 3.55))  # K of (E4)

Disc = tuple[float, float, float]  # x, y, radius [m]

_WAY = ((0.0, 0.0), (5.0, 0.0))  # where the scenario starts and where it ends [m]
_CLEARANCE = 0.6  # from both to the surface of a disc, at least [m]
_NARROWEST = 0.2  # between the surfaces of two discs, at least [m]


def car_course(seed: int) -> dict[str, Any]:
    """Returns a random course, as overrides of the scenario `car-sensitivity`.

    A course sets the input limits, the push, the discs and the gains of their barriers.
    Start, target and approach gain stay the scenario's; a study drives every course
    with each of `APPROACH_GAINS`.

    Args:
        seed: Which course; the same seed gives the same course.
    """
    draw = _Draw(seed)
    force, turn_rate = draw("force limit [N]"), draw("turn rate limit [rad/s]")
    push = round(draw("push over force limit") * force / CarParameters().mass, 3)
    gains = BARRIER_GAINS[draw.index(len(BARRIER_GAINS))]
    discs = _gate(draw)
    for _ in range(OTHER_DISCS[draw.index(len(OTHER_DISCS))]):
        discs.append(_other_disc(draw, discs))
    return {
        "name": f"car-course-{seed}",
        "input_set": {"lower": [-force, -turn_rate], "upper": [force, turn_rate]},
        "disturbance": [
            {"_tag": "!Sinusoid", "amplitude": [push], "frequency": 0.7, "phase": 0.0}
        ],
        "obstacles": [{"center": [x, y], "radius": radius} for x, y, radius in discs],
        "barrier": {"gains": list(gains)},
    }


class _Draw:
    """Draws from the ranges, to the millimetre, mrad and mN."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.default_rng([2503, seed])

    def __call__(self, name: str) -> float:
        return round(float(self._generator.uniform(*CAR_COURSE_RANGES[name])), 3)

    def index(self, count: int) -> int:
        return int(self._generator.integers(count))


def _gate(draw: _Draw) -> list[Disc]:
    """Two discs, one on each side of a gap, clear of both ends of the way."""
    while True:
        x, y = draw("gate along the way [m]"), draw("gate beside the way [m]")
        angle, width = draw("gate turned by [rad]"), draw("gate width [m]")
        discs = []
        for side in (1.0, -1.0):
            radius = draw("disc radius [m]")
            reach = side * (0.5 * width + radius)
            across = (-math.sin(angle) * reach, math.cos(angle) * reach)
            discs.append((round(x + across[0], 3), round(y + across[1], 3), radius))
        if all(map(_is_clear, discs)):
            return discs


def _other_disc(draw: _Draw, discs: list[Disc]) -> Disc:
    """A disc anywhere about the way, clear of its ends and of the discs so far."""
    while True:
        disc = (
            draw("other disc along the way [m]"),
            draw("other disc beside the way [m]"),
            draw("disc radius [m]"),
        )
        if _is_clear(disc) and all(_gap(disc, other) >= _NARROWEST for other in discs):
            return disc


def _is_clear(disc: Disc) -> bool:
    return all(_gap(disc, (x, y, 0.0)) >= _CLEARANCE for x, y in _WAY)


def _gap(disc: Disc, other: Disc) -> float:
    return math.dist(disc[:2], other[:2]) - disc[2] - other[2]
