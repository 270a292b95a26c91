"""The mathematics of one control tick, and the Drake system that runs it."""

from vcbf_drake.safety.add_safety_filter import AddedSafetyFilter, AddSafetyFilter
from vcbf_drake.safety.assumptions import Assumption, assumptions
from vcbf_drake.safety.corrections import FIDELITIES, Corrections, Fidelity
from vcbf_drake.safety.ellipsoid import Ellipsoid, inscribed_ellipsoid
from vcbf_drake.safety.feasibility_measure import MEASURES, FeasibilityMeasure
from vcbf_drake.safety.feasible_set import (
    DisturbanceKnowledge,
    FeasibleSet,
    disturbance_margin,
)
from vcbf_drake.safety.filter_qp import (
    INFEASIBLE_POLICIES,
    FilterDecision,
    FilterStatus,
    InfeasiblePolicy,
)
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.methods import METHODS, Method
from vcbf_drake.safety.packed_feasible_set import (
    PackedFeasibleSet,
    unpack_feasible_set,
)
from vcbf_drake.safety.polytope import (
    Emptiness,
    chebyshev_ball,
    emptiness_certificate,
)
from vcbf_drake.safety.safety_filter import SafetyFilter
from vcbf_drake.safety.volume_barrier import Volume, VolumeBarrier

__all__ = [
    "FIDELITIES",
    "INFEASIBLE_POLICIES",
    "MEASURES",
    "METHODS",
    "AddSafetyFilter",
    "AddedSafetyFilter",
    "Assumption",
    "Corrections",
    "DisturbanceKnowledge",
    "Ellipsoid",
    "Emptiness",
    "FeasibilityMeasure",
    "FeasibleSet",
    "Fidelity",
    "FilterDecision",
    "FilterStatus",
    "InfeasiblePolicy",
    "InputSet",
    "Method",
    "PackedFeasibleSet",
    "SafetyFilter",
    "Volume",
    "VolumeBarrier",
    "assumptions",
    "chebyshev_ball",
    "disturbance_margin",
    "emptiness_certificate",
    "inscribed_ellipsoid",
    "unpack_feasible_set",
]
