"""Drake systems for robust safety filters whose QP stays feasible.

The names below are the public surface. They are loaded when first used, so that
importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vcbf_drake.barriers import Barrier, SphereObstacle
    from vcbf_drake.disturbances import (
        DisturbanceSource,
        LinearDisturbanceObserver,
        RiseObserver,
    )
    from vcbf_drake.errors import (
        EmptySetError,
        ModelError,
        ScenarioError,
        SolverError,
        UnboundedSetError,
        VcbfError,
    )
    from vcbf_drake.model import ControlAffineModel
    from vcbf_drake.plants import Blimp, BlimpController, Car, CarController
    from vcbf_drake.safety import (
        AddSafetyFilter,
        InputSet,
        SafetyFilter,
        chebyshev_ball,
        inscribed_ellipsoid,
    )
    from vcbf_drake.simulation import load_scenario, make_loop, simulate

_HOME = {
    "AddSafetyFilter": "safety",
    "Barrier": "barriers",
    "Blimp": "plants",
    "BlimpController": "plants",
    "Car": "plants",
    "CarController": "plants",
    "ControlAffineModel": "model",
    "DisturbanceSource": "disturbances",
    "EmptySetError": "errors",
    "InputSet": "safety",
    "LinearDisturbanceObserver": "disturbances",
    "ModelError": "errors",
    "RiseObserver": "disturbances",
    "SafetyFilter": "safety",
    "ScenarioError": "errors",
    "SolverError": "errors",
    "SphereObstacle": "barriers",
    "UnboundedSetError": "errors",
    "VcbfError": "errors",
    "chebyshev_ball": "safety",
    "inscribed_ellipsoid": "safety",
    "load_scenario": "simulation",
    "make_loop": "simulation",
    "simulate": "simulation",
}

__all__ = [
    "AddSafetyFilter",
    "Barrier",
    "Blimp",
    "BlimpController",
    "Car",
    "CarController",
    "ControlAffineModel",
    "DisturbanceSource",
    "EmptySetError",
    "InputSet",
    "LinearDisturbanceObserver",
    "ModelError",
    "RiseObserver",
    "SafetyFilter",
    "ScenarioError",
    "SolverError",
    "SphereObstacle",
    "UnboundedSetError",
    "VcbfError",
    "chebyshev_ball",
    "inscribed_ellipsoid",
    "load_scenario",
    "make_loop",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
