"""What must stay true: barriers and limits, and the rows they put on the input."""

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.barrier_rows import BarrierRows
from vcbf_drake.barriers.barrier_set import BarrierSet
from vcbf_drake.barriers.input_limits import StateInputLimit, ackermann_limit
from vcbf_drake.barriers.obstacles import SphereObstacle

__all__ = [
    "Barrier",
    "BarrierRows",
    "BarrierSet",
    "SphereObstacle",
    "StateInputLimit",
    "ackermann_limit",
]
