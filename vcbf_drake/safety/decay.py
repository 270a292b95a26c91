"""DecayRates: barriers that may fall faster where else no input is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.linalg import LinAlgError

from vcbf_drake.barriers import Barrier, BarrierRows
from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError, SolverError
from vcbf_drake.safety.feasible_set import FeasibleSet
from vcbf_drake.safety.tick_qp import QP, least_violation

# By which share of itself a level may fall in a period, to first order.
_LARGEST_STEP = 0.9
_ROUNDING = 4.0 * float(np.finfo(float).eps)
# What (omega - 1)^2 costs beside the distance to the reference.
_PENALTY = 100.0


@dataclass(frozen=True)
class DecayRates:
    """How much each barrier's last decay rate may grow (E99).

    A row asks for phi' >= -lambda phi, with phi = phi_(r-1) and lambda = lambda_r of
    (E3), or for phi' >= -class_k(phi). With a factor omega on the right its right-hand
    side grows by (omega - 1) lambda phi, and phi stays positive all the same.

    Source: Zeng et al. (2021), optimal decay; that it acts only where the rows have no
    input, and its limit in sampled time, are ours.

    Attributes:
        slopes: lambda phi or class_k(phi), shape (N,); 0 where no rate helps: phi is
            not positive, or the row is a limit of the input.
        most: The largest omega, shape (N,), not below 1.
    """

    slopes: Array
    most: Array

    @staticmethod
    def at(rows: BarrierRows, barriers: Sequence[Any], period: float) -> DecayRates:
        """Returns the rates at a tick.

        Args:
            rows: The barriers' rows there.
            barriers: The barriers.
            period: For how long an input is held [s].
        """
        slopes, most = np.zeros(len(barriers)), np.ones(len(barriers))
        for i, (barrier, phi) in enumerate(zip(barriers, rows.chain, strict=True)):
            if isinstance(barrier, Barrier) and phi[-1] > 0.0:
                level = float(phi[-1])
                linear = float(barrier.decay_rates[-1]) * level
                slope = float(barrier.class_k(level)) if barrier.class_k else linear
                if 0.0 < slope < math.inf:
                    slopes[i] = slope
                    most[i] = max(1.0, _LARGEST_STEP * level / (period * slope))
        return DecayRates(slopes, most)


def decayed_input(
    feasible: FeasibleSet,
    qp: QP,
    rates: DecayRates,
    held_input: Array,
    solver: str,
) -> tuple[Array, float]:
    """Returns the input nearest to the reference with faster decay (E99), and omega.

    That is the largest factor; where none helps it is 1, and the input that of the
    least violation.

    Args:
        feasible: Input limits and barrier rows, without an input.
        qp: The QP of its rows, `QP.hard`.
        rates: How much faster the barriers may fall.
        held_input: The input applied now, shape (m,); for the fallback.
        solver: The solver's name.
    """
    m, unit = len(qp.reference), math.sqrt(_PENALTY / qp.frame.cost_unit)
    barriers = feasible.cutting[qp.num_firm :] - feasible.num_input_rows
    grows = np.flatnonzero(rates.slopes[barriers] > 0.0)
    barriers, count = barriers[grows], len(grows)
    # In the variables (z, unit (omega - 1)) the cost is a distance.
    slopes = np.zeros((len(qp.b), count))
    per_unit = rates.slopes[barriers] / (unit * qp.frame.size)
    slopes[qp.num_firm + grows, np.arange(count)] = -per_unit
    sides = np.vstack([np.eye(count), -np.eye(count)])
    most = unit * (rates.most[barriers] - 1.0)
    grown = replace(
        qp,
        A=np.block([[qp.A, slopes], [np.zeros((2 * count, m)), sides]]),
        b=np.concatenate([qp.b, most, np.zeros(count)]),
        reference=np.append(qp.reference, np.zeros(count)),
        num_hard=len(qp.b) + 2 * count,
    )
    try:
        z = grown.solved(solver).point
    except (EmptySetError, SolverError, LinAlgError):
        return least_violation(feasible, qp, held_input, solver), 1.0
    growth = float(np.max(z[m:], initial=0.0)) / unit
    # Rounded up, so that the rows hold with it where their numbers are large.
    omega = (1.0 + growth) * (1.0 + _ROUNDING) if growth > 0.0 else 1.0
    return feasible.input_set.project(qp.frame.input(z)), omega
