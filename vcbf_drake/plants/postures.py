"""Postures of a robot: inverse kinematics, and the effort at rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces_
from pydrake.solvers import Solve

from vcbf_drake.checks import Array
from vcbf_drake.errors import InvalidValueError

_TRIES = 20
_NEAR = 0.005  # The tolerance of the posture at the target [m].


class Posture(NamedTuple):
    """A posture in which a robot rests.

    Attributes:
        positions: q, shape (nq,).
        effort: The input that holds it there, shape (m,); 0 if not requested.
    """

    positions: Array
    effort: Array


def posture_at(
    plant: MultibodyPlant,
    frame: str,
    point: Sequence[float],
    target: Sequence[float],
    near: Sequence[float],
    at_rest: bool,
) -> Posture:
    """Returns a posture within the joints' ranges whose point is at the target.

    A floating base keeps the file's pose.

    Args:
        plant: The robot.
        frame: The name of the frame or body that carries the point.
        point: The point in that frame, shape (3,) [m].
        target: The position for the point, shape (3,) [m].
        near: The positions near which a posture is chosen, shape (nq,).
        at_rest: Whether the motors must be able to hold it.

    Raises:
        InvalidValueError: There is no such posture.
    """
    kinematics = InverseKinematics(plant)
    q, program = kinematics.q(), kinematics.prog()
    goal, reach = np.array(target), 0.5 * _NEAR
    kinematics.AddPositionConstraint(
        *(plant.GetFrameByName(frame), np.array(point), plant.world_frame()),
        *(goal - reach, goal + reach),
    )
    seed = np.array(near, dtype=float)
    for body in map(plant.get_body, plant.GetFloatingBaseBodies()):
        base = np.arange(body.floating_positions_start(), len(q))[:7]
        base = base[: 7 if body.has_quaternion_dofs() else 6]
        seed[base] = plant.GetDefaultPositions()[base]
        program.AddBoundingBoxConstraint(seed[base], seed[base], q[base])
    program.AddQuadraticErrorCost(np.eye(len(q)), seed, q)
    u = program.NewContinuousVariables(plant.num_actuators(), "u")
    program.AddBoundingBoxConstraint(
        plant.GetEffortLowerLimits(), plant.GetEffortUpperLimits(), u
    )
    program.AddQuadraticErrorCost(1e-6 * np.eye(len(u)), np.zeros(len(u)), u)
    rule = "a place that the robot reaches within its joints' ranges"
    if at_rest:
        none = np.zeros(plant.num_velocities())
        still = _StaticBalance(plant)
        program.AddConstraint(still, none, none, np.concatenate([q, u]))
        rule += ", and where its motors can hold it"
    for guess in _guesses(plant, seed):
        solved = Solve(program, np.concatenate([guess, np.zeros(len(u))]))
        if solved.is_success():
            return Posture(solved.GetSolution(q), solved.GetSolution(u))
    raise InvalidValueError("target", f"{[*target]}; it must be {rule}")


def _guesses(plant: MultibodyPlant, seed: Array) -> Iterator[Array]:
    """The initial guesses: a posture, then seeded ones within the joints' ranges."""
    low = np.fmax(plant.GetPositionLowerLimits(), -np.pi)
    high = np.fmin(plant.GetPositionUpperLimits(), np.pi)
    yield np.clip(seed, low, high)
    random = np.random.default_rng(0)
    for _ in range(_TRIES):
        yield random.uniform(low, high)


class _StaticBalance:
    """The residual generalised forces at rest, a function of [q; u]; 0 in balance."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self._plants = {float: plant, object: plant.ToAutoDiffXd()}
        self._contexts = {
            kind: each.CreateDefaultContext() for kind, each in self._plants.items()
        }
        self._matrix = plant.MakeActuationMatrix()

    def __call__(self, q_and_u: Any) -> Any:
        kind = object if q_and_u.dtype == object else float
        plant, context = self._plants[kind], self._contexts[kind]
        q, u = np.split(q_and_u, [plant.num_positions()])
        still = np.zeros(plant.num_velocities())
        plant.SetPositionsAndVelocities(context, np.concatenate([q, still]))
        forces = MultibodyForces_[AutoDiffXd if kind is object else float](plant)
        plant.CalcForceElementsContribution(context, forces)
        return self._matrix @ u - plant.CalcInverseDynamics(context, still, forces)
