"""The mathematics of one control tick, and the Drake system that runs it."""

from vcbf_drake.safety.assumptions import Assumption, assumptions
from vcbf_drake.safety.decision import (
    FilterDecision,
    FilterStatus,
    InfeasiblePolicy,
    RowHolder,
    Tick,
)
from vcbf_drake.safety.ellipsoid import Ellipsoid, inscribed_ellipsoid
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.polytope import chebyshev_ball, emptiness_certificate
from vcbf_drake.safety.qp import DisturbanceKnowledge, FeasibleSet, disturbance_margin
from vcbf_drake.safety.safety_filter import SafetyFilter
from vcbf_drake.safety.settings import (
    BETWEEN_TICKS,
    FIDELITIES,
    METHODS,
    Corrections,
    FilterSettings,
    Method,
)
from vcbf_drake.safety.volume import (
    PackedFeasibleSet,
    Volume,
    VolumeBarrier,
    unpack_feasible_set,
)

__all__ = [
    "BETWEEN_TICKS",
    "FIDELITIES",
    "METHODS",
    "Assumption",
    "Corrections",
    "DisturbanceKnowledge",
    "Ellipsoid",
    "FeasibleSet",
    "FilterDecision",
    "FilterSettings",
    "FilterStatus",
    "InfeasiblePolicy",
    "InputSet",
    "Method",
    "PackedFeasibleSet",
    "RowHolder",
    "SafetyFilter",
    "Tick",
    "Volume",
    "VolumeBarrier",
    "assumptions",
    "chebyshev_ball",
    "disturbance_margin",
    "emptiness_certificate",
    "inscribed_ellipsoid",
    "unpack_feasible_set",
]
