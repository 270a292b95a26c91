"""Barriers, limits on the input, and the rows that they impose on it."""

from vcbf_drake.barriers.barrier import Barrier, all_of, any_of
from vcbf_drake.barriers.barrier_set import BarrierSet
from vcbf_drake.barriers.limits import StateInputLimit, StateLimit, ackermann_limit
from vcbf_drake.barriers.moving import MovingObstacle, PerceivedSpheres
from vcbf_drake.barriers.obstacles import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    SphereObstacle,
)
from vcbf_drake.barriers.polygons import PolygonObstacle
from vcbf_drake.barriers.rows import BarrierRows
from vcbf_drake.barriers.shapes import Geofence, HalfSpace, PairDistance

__all__ = [
    "Barrier",
    "BarrierRows",
    "BarrierSet",
    "BoxObstacle",
    "CapsuleObstacle",
    "EllipsoidObstacle",
    "Geofence",
    "HalfSpace",
    "MovingObstacle",
    "PairDistance",
    "PerceivedSpheres",
    "PolygonObstacle",
    "SphereObstacle",
    "StateInputLimit",
    "StateLimit",
    "ackermann_limit",
    "all_of",
    "any_of",
]
