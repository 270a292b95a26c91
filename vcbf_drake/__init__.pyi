"""The public names of the package, each from where it is defined."""

from .add_safety_filter import (
    AddedSafetyFilter as AddedSafetyFilter,
    AddSafetyFilter as AddSafetyFilter,
)
from .barriers import (
    Barrier as Barrier,
    BarrierSet as BarrierSet,
    BoxObstacle as BoxObstacle,
    CapsuleObstacle as CapsuleObstacle,
    EllipsoidObstacle as EllipsoidObstacle,
    Geofence as Geofence,
    HalfSpace as HalfSpace,
    PairDistance as PairDistance,
    PerceivedSpheres as PerceivedSpheres,
    SphereObstacle as SphereObstacle,
    StateInputLimit as StateInputLimit,
    StateLimit as StateLimit,
    ackermann_limit as ackermann_limit,
)
from .disturbances import (
    BandLimitedNoise as BandLimitedNoise,
    Constant as Constant,
    DisturbanceBounds as DisturbanceBounds,
    DisturbanceEstimate as DisturbanceEstimate,
    DisturbanceObserver as DisturbanceObserver,
    DisturbanceSource as DisturbanceSource,
    LinearDisturbanceObserver as LinearDisturbanceObserver,
    ObserverSettings as ObserverSettings,
    Recorded as Recorded,
    RiseObserver as RiseObserver,
    Sinusoid as Sinusoid,
    SmoothStep as SmoothStep,
)
from .errors import (
    EmptySetError as EmptySetError,
    ModelError as ModelError,
    ScenarioError as ScenarioError,
    SolverError as SolverError,
    UnboundedSetError as UnboundedSetError,
    VcbfError as VcbfError,
)
from .model import (
    ControlAffineModel as ControlAffineModel,
    Manoeuvre as Manoeuvre,
    Plan as Plan,
    point_position as point_position,
)
from .plants import (
    Blimp as Blimp,
    BlimpController as BlimpController,
    BlimpControllerParameters as BlimpControllerParameters,
    BlimpParameters as BlimpParameters,
    Car as Car,
    CarController as CarController,
    CarControllerParameters as CarControllerParameters,
    CarParameters as CarParameters,
    StateFeedback as StateFeedback,
    Vehicle as Vehicle,
)
from .safety import (
    METHODS as METHODS,
    Corrections as Corrections,
    FilterSettings as FilterSettings,
    FilterStatus as FilterStatus,
    InputSet as InputSet,
    SafetyFilter as SafetyFilter,
    VolumeBarrier as VolumeBarrier,
    assumptions as assumptions,
)
from .simulation import (
    Fleet as Fleet,
    InputLimits as InputLimits,
    Scenario as Scenario,
    load_fleet as load_fleet,
    load_scenario as load_scenario,
    make_loop as make_loop,
    simulate as simulate,
    simulate_fleet as simulate_fleet,
)

__version__: str
