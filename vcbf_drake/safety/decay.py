"""DecayRates: barriers that may decay faster than their gains allow (E69)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from vcbf_drake.barriers import Barrier
from vcbf_drake.checks import Array
from vcbf_drake.safety.qp import QP, FeasibleSet

# The share of itself by which a level may fall in a period, to first order.
_LARGEST_STEP = 0.9
_ROUNDING = 4.0 * float(np.finfo(float).eps)
DEFAULT_PENALTY = 100.0


@dataclass(frozen=True)
class DecayRates:
    """The growth of each barrier's last decay rate, and its limit (E69).

    A row asks for phi' >= -lambda phi, with phi = phi_(r-1) and lambda = lambda_r of
    (E3), or for phi' >= -class_k(phi). With a factor omega on the right its right-hand
    side grows by (omega - 1) lambda phi, and phi stays positive all the same.

    Source: Zeng et al. (2021), optimal decay; its limit in sampled time, and that it
    may act only where the rows have no input, are ours.

    Attributes:
        slopes: lambda phi or class_k(phi), shape (N,); 0 where no rate helps: phi is
            not positive, or the row is a limit of the input.
        most: The largest omega, shape (N,), not below 1.
        penalty: The penalty of (omega - 1)^2 beside the squared distance to the
            reference.
        only_where_empty: Whether rates grow only where the rows have no input.
    """

    slopes: Array
    most: Array
    penalty: float = DEFAULT_PENALTY
    only_where_empty: bool = True

    @staticmethod
    def at(
        chain: Sequence[Array] | Array,
        barriers: Sequence[Any],
        period: float,
        penalty: float = DEFAULT_PENALTY,
        only_where_empty: bool = True,
    ) -> DecayRates:
        """Returns the rates at a tick.

        Args:
            chain: phi_0, ..., phi_(r-1) of each row; further entries are ignored.
            barriers: The barriers and limits behind the rows.
            period: The hold period [s].
            penalty: The penalty of the squared growth.
            only_where_empty: Whether they grow only where the rows have no input.
        """
        slopes, most = np.zeros(len(barriers)), np.ones(len(barriers))
        for i, (barrier, phi) in enumerate(zip(barriers, chain, strict=True)):
            if not isinstance(barrier, Barrier):
                continue
            level = float(phi[: len(barrier.decay_rates)][-1])
            if level > 0.0:
                linear = float(barrier.decay_rates[-1]) * level
                slope = float(barrier.class_k(level)) if barrier.class_k else linear
                if 0.0 < slope < math.inf:
                    slopes[i] = slope
                    most[i] = max(1.0, _LARGEST_STEP * level / (period * slope))
        return DecayRates(slopes, most, penalty, only_where_empty)

    @property
    def room(self) -> Array:
        """The greatest growth of each row's right-hand side, shape (N,)."""
        return self.slopes * (self.most - 1.0)

    def grown(self, qp: QP, feasible: FeasibleSet) -> QP:
        """Returns a QP with the factors omega as variables (E69).

        In the variables (z, root of the penalty times (omega - 1), slacks) the cost is
        a distance again.

        Args:
            qp: The QP at the barriers' own rates, without a volume row.
            feasible: The feasible set that it was stated of.
        """
        grows = np.flatnonzero(self.slopes[feasible.cut] > 0.0)
        barriers, count = feasible.cut[grows], len(grows)
        m, n = len(qp.frame.scale), qp.num_hard
        unit = math.sqrt(self.penalty / qp.frame.cost_unit)
        slopes = np.zeros((len(qp.b), count))
        per_unit = self.slopes[barriers] / unit
        slopes[qp.num_firm + grows, np.arange(count)] = -per_unit
        sides = np.zeros((2 * count, len(qp.reference) + count))
        sides[:, m : m + count] = np.vstack([np.eye(count), -np.eye(count)])
        most = unit * (self.most[barriers] - 1.0)
        A = np.hstack([qp.A[:, :m], slopes, qp.A[:, m:]])
        names = [feasible.num_input_rows + i for i in barriers.tolist()]
        return qp._replace(
            A=np.vstack([A[:n], sides, A[n:]]),
            b=np.concatenate([qp.b[:n], most, np.zeros(count), qp.b[n:]]),
            reference=np.insert(qp.reference, m, np.zeros(count)),
            rows=(*qp.rows[:n], *names, *names, *qp.rows[n:]),
            num_hard=n + 2 * count,
        )

    def factor(self, feasible: FeasibleSet, u: Array) -> float:
        """Returns the largest omega that an input asks for, 1 where it asks for none.

        Args:
            feasible: The feasible set.
            u: The input, shape (m,).
        """
        excess = feasible.rows.A @ u - feasible.bound
        grows = (self.slopes > 0.0) & np.isinf(feasible.costs.penalties)
        growth = float(np.max(excess[grows] / self.slopes[grows], initial=0.0))
        # Rounded up, so that the rows hold with it where their numbers are large.
        return (1.0 + growth) * (1.0 + _ROUNDING) if growth > 0.0 else 1.0
