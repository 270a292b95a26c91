"""The blimp and the car: meshes in the body frame, x forward, z up, in true size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.viz.mesh import Mesh, merge, prism, revolve

# The envelope of the indoor blimps whose mass and drag the scenarios use [m].
BLIMP_LENGTH, BLIMP_WIDTH = 0.77, 0.51
CAR_LENGTH, CAR_WIDTH, WHEEL_RADIUS = 0.42, 0.2, 0.04

CREAM, GRAPHITE, RUBBER, GLASS, SILVER, LAMP = (
    "#f7f4ec",
    "#39424e",
    "#23272e",
    "#2c3a4a",
    "#c9d0d9",
    "#fff3c4",
)


@dataclass(frozen=True)
class Part:
    """A piece of a vehicle.

    Attributes:
        name: The piece's name.
        mesh: Its surface in the body frame.
        color: A hexadecimal colour.
    """

    name: str
    mesh: Mesh
    color: str


def blimp(color: str) -> list[Part]:
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


def car(color: str) -> list[Part]:
    """A small car whose wheels stand on z = 0, its body in a method's colour."""
    return [
        Part("body", _car_body(), color),
        Part("cabin", _cabin(), GLASS),
        Part("roof", _roof(), color),
        Part("wheels", _wheels(WHEEL_RADIUS, 0.036), RUBBER),
        Part("hubs", _wheels(0.55 * WHEEL_RADIUS, 0.04), SILVER),
        Part("lamps", _lamps(), LAMP),
    ]


VEHICLES: dict[str, Callable[[str], list[Part]]] = {"blimp": blimp, "car": car}


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
    return merge([fin.moved(turn=_about_x(turn)) for turn in turns])


def _gondola() -> Mesh:
    angle = np.linspace(0.0, np.pi, 15)
    profile = np.stack([-0.11 * np.cos(angle), 0.042 * np.sqrt(np.sin(angle))], axis=1)
    return revolve(profile, sides=20).moved((0.02, 0.0, -0.265))


def _propellers() -> Mesh:
    """Two motors on an arm through the gondola, each with two blades."""
    arm = revolve([(-0.13, 0.006), (0.13, 0.006)], 8).moved(turn=_about_z(0.5 * np.pi))
    motor = revolve([(-0.03, 0.0), (-0.03, 0.012), (0.02, 0.016), (0.045, 0.0)], 14)
    outline = [(0.028, 0.065), (0.036, 0.065), (0.036, -0.065), (0.028, -0.065)]
    blade = prism(outline, 0.007)
    side = merge([motor, blade.moved(turn=_about_x(0.5))])
    pieces = [arm, side.moved((0.0, 0.13, 0.0)), side.moved((0.0, -0.13, 0.0))]
    return merge(pieces).moved((0.02, 0.0, -0.265))


def _car_body() -> Mesh:
    outline = [
        (-0.21, 0.035),
        (-0.21, 0.085),
        (-0.185, 0.1),
        (0.09, 0.096),
        (0.185, 0.078),
        (0.21, 0.06),
        (0.21, 0.035),
        (0.19, 0.024),
        (-0.19, 0.024),
    ]
    return prism(outline, 0.5 * CAR_WIDTH - 0.012, 0.012)


def _cabin() -> Mesh:
    outline = [(-0.165, 0.095), (-0.115, 0.148), (0.02, 0.148), (0.1, 0.093)]
    return prism(outline, 0.075, 0.012)


def _roof() -> Mesh:
    outline = [(-0.118, 0.145), (-0.11, 0.153), (0.015, 0.153), (0.026, 0.145)]
    return prism(outline, 0.07, 0.006)


def _wheels(radius: float, width: float) -> Mesh:
    half = 0.5 * width
    edge = 0.2 * radius
    profile = [(-half, 0.0), (-half, radius - edge), (edge - half, radius)]
    profile += [(half - edge, radius), (half, radius - edge), (half, 0.0)]
    wheel = revolve(profile, 24).moved(turn=_about_z(0.5 * np.pi))
    places = [(x, y, WHEEL_RADIUS) for x in (-0.13, 0.13) for y in (-0.092, 0.092)]
    return merge([wheel.moved(place) for place in places])


def _lamps() -> Mesh:
    outline = [(0.2, 0.066), (0.212, 0.06), (0.212, 0.048), (0.2, 0.048)]
    lamp = prism(outline, 0.018, 0.002)
    return merge([lamp.moved((0.0, y, 0.0)) for y in (-0.06, 0.06)])


def _about_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
