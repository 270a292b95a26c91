"""The control-affine model of any Drake System, derived and compiled symbolically."""

from vcbf_drake.model.control_affine import ControlAffineModel
from vcbf_drake.model.manoeuvre import Manoeuvre, Plan
from vcbf_drake.model.position import point_position

__all__ = [
    "ControlAffineModel",
    "Manoeuvre",
    "Plan",
    "point_position",
]
