"""Vehicles: their contract, the shipped blimp and car, and robots from files."""

from vcbf_drake.plants.blimp import (
    Blimp,
    Blimp_,
    BlimpController,
    BlimpControllerParameters,
    BlimpParameters,
    BlimpVehicle,
)
from vcbf_drake.plants.car import (
    Car,
    Car_,
    CarController,
    CarControllerParameters,
    CarParameters,
    CarVehicle,
    TurnLimit,
)
from vcbf_drake.plants.controllers import StateFeedback
from vcbf_drake.plants.multibody_vehicle import MultibodyVehicle
from vcbf_drake.plants.shapes import Part
from vcbf_drake.plants.vehicle import Vehicle

__all__ = [
    "Blimp",
    "BlimpController",
    "BlimpControllerParameters",
    "BlimpParameters",
    "BlimpVehicle",
    "Blimp_",
    "Car",
    "CarController",
    "CarControllerParameters",
    "CarParameters",
    "CarVehicle",
    "Car_",
    "MultibodyVehicle",
    "Part",
    "StateFeedback",
    "TurnLimit",
    "Vehicle",
]
