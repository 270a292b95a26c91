"""Vehicles, and the two that come with the package: the blimp and the car."""

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
from vcbf_drake.plants.blimp_vehicle import BlimpVehicle
from vcbf_drake.plants.car import Car, Car_, CarInput, CarParameters, CarState
from vcbf_drake.plants.car_controller import CarController, CarControllerParameters
from vcbf_drake.plants.car_vehicle import CarVehicle, TurnLimit
from vcbf_drake.plants.multibody_vehicle import MultibodyVehicle
from vcbf_drake.plants.shapes import Part
from vcbf_drake.plants.vehicle import StateFeedback, Vehicle

__all__ = [
    "Blimp",
    "BlimpController",
    "BlimpControllerParameters",
    "BlimpInput",
    "BlimpParameters",
    "BlimpState",
    "BlimpVehicle",
    "Blimp_",
    "Car",
    "CarController",
    "CarControllerParameters",
    "CarInput",
    "CarParameters",
    "CarState",
    "CarVehicle",
    "Car_",
    "MultibodyVehicle",
    "Part",
    "StateFeedback",
    "TurnLimit",
    "Vehicle",
]
