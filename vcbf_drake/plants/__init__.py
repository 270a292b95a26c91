"""What is controlled: two plants, and the control-affine model of any Drake System."""

from vcbf_drake.plants.blimp import (
    Blimp,
    Blimp_,
    BlimpInput,
    BlimpParameters,
    BlimpState,
)
from vcbf_drake.plants.car import Car, Car_, CarInput, CarParameters, CarState
from vcbf_drake.plants.compiled import compile_expressions
from vcbf_drake.plants.control_affine import ControlAffineModel
from vcbf_drake.plants.point_position import point_position

__all__ = [
    "Blimp",
    "BlimpInput",
    "BlimpParameters",
    "BlimpState",
    "Blimp_",
    "Car",
    "CarInput",
    "CarParameters",
    "CarState",
    "Car_",
    "ControlAffineModel",
    "compile_expressions",
    "point_position",
]
