"""The car's meshes in the body frame, x forward, z up, in true size."""

from __future__ import annotations

import numpy as np

from vcbf_drake.plants.mesh import Mesh, Part, about_z, merge, prism, revolve

CAR_LENGTH, CAR_WIDTH, WHEEL_RADIUS = 0.42, 0.2, 0.04

RUBBER, GLASS, SILVER, LAMP = "#23272e", "#2c3a4a", "#c9d0d9", "#fff3c4"


def car_parts(color: str) -> list[Part]:
    """A small car whose wheels stand on z = 0, its body in a method's colour."""
    return [
        Part("body", _car_body(), color),
        Part("cabin", _cabin(), GLASS),
        Part("roof", _roof(), color),
        Part("wheels", _wheels(WHEEL_RADIUS, 0.036), RUBBER),
        Part("hubs", _wheels(0.55 * WHEEL_RADIUS, 0.04), SILVER),
        Part("lamps", _lamps(), LAMP),
    ]


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
    wheel = revolve(profile, 24).moved(turn=about_z(0.5 * np.pi))
    places = [(x, y, WHEEL_RADIUS) for x in (-0.13, 0.13) for y in (-0.092, 0.092)]
    return merge([wheel.moved(place) for place in places])


def _lamps() -> Mesh:
    outline = [(0.2, 0.066), (0.212, 0.06), (0.212, 0.048), (0.2, 0.048)]
    lamp = prism(outline, 0.018, 0.002)
    return merge([lamp.moved((0.0, y, 0.0)) for y in (-0.06, 0.06)])
