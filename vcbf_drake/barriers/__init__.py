"""What must stay true: barriers and limits, and the rows they put on the input."""

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.barrier_set import BarrierSet
from vcbf_drake.barriers.box_obstacle import BoxObstacle
from vcbf_drake.barriers.capsule_obstacle import CapsuleObstacle
from vcbf_drake.barriers.ellipsoid_obstacle import EllipsoidObstacle
from vcbf_drake.barriers.geofence import Geofence
from vcbf_drake.barriers.half_space import HalfSpace
from vcbf_drake.barriers.limits import StateInputLimit, StateLimit, ackermann_limit
from vcbf_drake.barriers.obstacles import SphereObstacle
from vcbf_drake.barriers.pair_distance import PairDistance
from vcbf_drake.barriers.perceived_spheres import PerceivedSpheres
from vcbf_drake.barriers.rows import BarrierRows

__all__ = [
    "Barrier",
    "BarrierRows",
    "BarrierSet",
    "BoxObstacle",
    "CapsuleObstacle",
    "EllipsoidObstacle",
    "Geofence",
    "HalfSpace",
    "PairDistance",
    "PerceivedSpheres",
    "SphereObstacle",
    "StateInputLimit",
    "StateLimit",
    "ackermann_limit",
]
