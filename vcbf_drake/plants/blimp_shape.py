"""The blimp's meshes in the body frame, x forward, z up, in true size."""

from __future__ import annotations

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.plants.mesh import Mesh, Part, about_x, about_z, merge, prism, revolve

# The envelope of the indoor blimps whose mass and drag the scenarios use [m].
BLIMP_LENGTH, BLIMP_WIDTH = 0.77, 0.51

CREAM, GRAPHITE, SILVER = "#f7f4ec", "#39424e", "#c9d0d9"


def blimp_parts(color: str) -> list[Part]:
    """An airship around the origin, its envelope in a method's colour."""
    return [
        Part("envelope", _envelope(-0.62, 0.66, 11), color),
        Part("nose", _envelope(0.66, 1.0, 7), CREAM),
        Part("tail", _envelope(-1.0, -0.62, 7), CREAM),
        Part("belt", _belt(), CREAM),
        Part("fins", _fins(), color),
        Part("gondola", _gondola(), GRAPHITE),
        Part("propellers", _propellers(), SILVER),
    ]


def _radius_at(along: Array) -> Array:
    """An ellipse that is a little fuller at the nose than at the tail."""
    return 0.5 * BLIMP_WIDTH * np.sqrt(1.0 - along**2) * (1.0 + 0.08 * along)


def _envelope(start: float, stop: float, rings: int, swell: float = 1.0) -> Mesh:
    """The envelope between two stations along its axis, -1 the tail, 1 the nose."""
    along = np.sin(np.linspace(np.arcsin(start), np.arcsin(stop), rings))
    profile = np.stack([0.5 * BLIMP_LENGTH * along, swell * _radius_at(along)], axis=1)
    return revolve(profile, sides=32)


def _belt() -> Mesh:
    return _envelope(-0.1, 0.02, 3, swell=1.006)


def _fins() -> Mesh:
    outline = [(-0.25, 0.14), (-0.335, 0.27), (-0.425, 0.27), (-0.4, 0.05)]
    fin = prism(outline[::-1], 0.008, 0.003)
    turns = 0.5 * np.pi * np.arange(4)
    return merge([fin.moved(turn=about_x(turn)) for turn in turns])


def _gondola() -> Mesh:
    angle = np.linspace(0.0, np.pi, 15)
    profile = np.stack([-0.11 * np.cos(angle), 0.042 * np.sqrt(np.sin(angle))], axis=1)
    return revolve(profile, sides=20).moved((0.02, 0.0, -0.265))


def _propellers() -> Mesh:
    """Two motors on an arm through the gondola, each with two blades."""
    arm = revolve([(-0.13, 0.006), (0.13, 0.006)], 8).moved(turn=about_z(0.5 * np.pi))
    motor = revolve([(-0.03, 0.0), (-0.03, 0.012), (0.02, 0.016), (0.045, 0.0)], 14)
    outline = [(0.028, 0.065), (0.036, 0.065), (0.036, -0.065), (0.028, -0.065)]
    blade = prism(outline, 0.007)
    side = merge([motor, blade.moved(turn=about_x(0.5))])
    pieces = [arm, side.moved((0.0, 0.13, 0.0)), side.moved((0.0, -0.13, 0.0))]
    return merge(pieces).moved((0.02, 0.0, -0.265))
