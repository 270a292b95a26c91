"""The blimp and the car: plants and their point-to-point controllers."""

from vcbf_drake.plants.blimp import (
    Blimp,
    Blimp_,
    BlimpInput,
    BlimpParameters,
    BlimpState,
)
from vcbf_drake.plants.blimp_controller import (
    BlimpController,
    BlimpControllerParameters,
)
from vcbf_drake.plants.car import Car, Car_, CarInput, CarParameters, CarState
from vcbf_drake.plants.car_controller import CarController, CarControllerParameters

__all__ = [
    "Blimp",
    "BlimpController",
    "BlimpControllerParameters",
    "BlimpInput",
    "BlimpParameters",
    "BlimpState",
    "Blimp_",
    "Car",
    "CarController",
    "CarControllerParameters",
    "CarInput",
    "CarParameters",
    "CarState",
    "Car_",
]
