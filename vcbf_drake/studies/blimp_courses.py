"""Random courses for the blimp: thrust, speed caps, wind and 4 to 9 spheres."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vcbf_drake.plants import BlimpParameters

# What a course draws uniformly, and from where. All ours: the paper prints no layout.
BLIMP_COURSE_RANGES: dict[str, tuple[float, float]] = {
    "thrust [m/s^2]": (0.5, 1.5),
    "reverse thrust over thrust": (0.1, 0.5),
    "surge speed cap [m/s]": (0.8, 2.0),
    "height error cap [m]": (0.3, 0.8),
    "sphere along the way": (0.2, 0.85),
    "sphere radius [m]": (0.5, 1.0),
}
# A course has this many spheres, each number as likely as the others.
SPHERE_COUNTS = (4, 5, 6, 7, 8, 9)
# The spread of the centres around the straight way: standard deviations [m].
SPHERE_SPREAD = (0.2, 0.7, 0.5)

_START, _TARGET = (0.0, 0.0, 0.0), (14.0, 3.0, 2.5)
_START_CLEARANCE, _TARGET_CLEARANCE = 1.5, 1.2  # to the surface of a sphere [m]
_YAW_ACCELERATION = 2.5  # the limit of the yaw moment over the inertia [rad/s^2]


def blimp_course(seed: int) -> dict[str, Any]:
    """Returns a random course, as overrides of `blimp-multiple-obstacles`.

    A course sets the input limits, the controller's speed caps, a wind of a tenth of
    the thrust, and the spheres. The scenario itself is course 5.

    Args:
        seed: Which course; the same seed gives the same course.
    """
    generator = np.random.default_rng([2024, seed])

    def draw(name: str) -> float:
        return float(generator.uniform(*BLIMP_COURSE_RANGES[name]))

    thrust, reverse = draw("thrust [m/s^2]"), draw("reverse thrust over thrust")
    plant = BlimpParameters()
    surge_mass, _, heave_mass = plant.effective_masses
    surge, heave = round(thrust * surge_mass, 4), round(thrust * heave_mass, 4)
    yaw = round(_YAW_ACCELERATION * plant.yaw_inertia, 4)
    return {
        "name": f"blimp-course-{seed}",
        "input_set": {
            "lower": [-round(reverse * surge, 4), -heave, -yaw],
            "upper": [surge, heave, yaw],
        },
        "vehicle": {
            "controller": {
                "surge_speed_cap": round(draw("surge speed cap [m/s]"), 2),
                "height_error_cap": round(draw("height error cap [m]"), 2),
            }
        },
        "disturbance": _wind(round(0.1 * thrust, 3)),
        "obstacles": _spheres(generator),
    }


def _wind(strength: float) -> list[dict[str, Any]]:
    """A gusty wind that reverses [m/s^2]."""
    sway, heave = round(0.5 * strength, 4), round(0.8 * strength, 4)
    return [
        _gust([strength, 0.0, 0.0], 0.8, 0.0),
        _gust([0.0, sway, 0.0], 0.8, 1.5708),
        _gust([0.0, 0.0, heave], 1.1, 0.5),
    ]


def _gust(amplitude: list[float], frequency: float, phase: float) -> dict[str, Any]:
    return {
        "_tag": "!Sinusoid",
        "amplitude": amplitude,
        "frequency": frequency,
        "phase": phase,
    }


def _spheres(generator: np.random.Generator) -> list[dict[str, Any]]:
    """Spheres scattered about the straight way, clear of both of its ends."""
    count = int(generator.integers(SPHERE_COUNTS[0], SPHERE_COUNTS[-1] + 1))
    spheres: list[dict[str, Any]] = []
    while len(spheres) < count:
        along = generator.uniform(*BLIMP_COURSE_RANGES["sphere along the way"])
        center = along * np.array(_TARGET) + generator.normal(0.0, SPHERE_SPREAD)
        radius = float(generator.uniform(*BLIMP_COURSE_RANGES["sphere radius [m]"]))
        if (
            math.dist(center, _START) > radius + _START_CLEARANCE
            and math.dist(center, _TARGET) > radius + _TARGET_CLEARANCE
        ):
            rounded = [round(float(x), 2) for x in center]
            spheres.append({"center": rounded, "radius": round(radius, 2)})
    return spheres
