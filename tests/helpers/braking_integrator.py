"""The double integrator whose backup manoeuvre is the full brake."""

from __future__ import annotations

import numpy as np
from pydrake.systems.primitives import LinearSystem

from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.manoeuvre import Manoeuvre


class FullBrake(Manoeuvre):
    """The law u_b = -1 for a time [s]; no plan is asked of it."""

    first = (0,)

    def __init__(self, horizon):
        self.horizon = horizon

    def input(self, state):
        raise NotImplementedError

    plan = input

    def law(self, x):
        return [-1.0]


def braking_integrator(horizon):
    """Returns the model of x1'' = u, disturbed in both states."""
    system = LinearSystem([[0, 1], [0, 0]], [[0], [1]], np.eye(2), np.zeros((2, 1)))
    model = ControlAffineModel.from_system(system)
    model.make_manoeuvres = lambda *_: [FullBrake(horizon)]
    return model
