"""Reference inputs: point-to-point controllers of the blimp and the car."""

from vcbf_drake.control.blimp_controller import (
    BlimpController,
    BlimpControllerParameters,
)
from vcbf_drake.control.car_controller import CarController, CarControllerParameters

__all__ = [
    "BlimpController",
    "BlimpControllerParameters",
    "CarController",
    "CarControllerParameters",
]
