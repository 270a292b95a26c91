"""The public names of the package, each from where it is defined."""

from .add_safety_filter import (
    AddedSafetyFilter as AddedSafetyFilter,
)
from .add_safety_filter import (
    AddSafetyFilter as AddSafetyFilter,
)
from .barriers import (
    Barrier as Barrier,
)
from .barriers import (
    BarrierSet as BarrierSet,
)
from .barriers import (
    BoxObstacle as BoxObstacle,
)
from .barriers import (
    CapsuleObstacle as CapsuleObstacle,
)
from .barriers import (
    EllipsoidObstacle as EllipsoidObstacle,
)
from .barriers import (
    Geofence as Geofence,
)
from .barriers import (
    HalfSpace as HalfSpace,
)
from .barriers import (
    PairDistance as PairDistance,
)
from .barriers import (
    PerceivedSpheres as PerceivedSpheres,
)
from .barriers import (
    SphereObstacle as SphereObstacle,
)
from .barriers import (
    StateInputLimit as StateInputLimit,
)
from .barriers import (
    StateLimit as StateLimit,
)
from .barriers import (
    ackermann_limit as ackermann_limit,
)
from .disturbances import (
    BandLimitedNoise as BandLimitedNoise,
)
from .disturbances import (
    Constant as Constant,
)
from .disturbances import (
    DisturbanceBounds as DisturbanceBounds,
)
from .disturbances import (
    DisturbanceEstimate as DisturbanceEstimate,
)
from .disturbances import (
    DisturbanceObserver as DisturbanceObserver,
)
from .disturbances import (
    DisturbanceSource as DisturbanceSource,
)
from .disturbances import (
    LinearDisturbanceObserver as LinearDisturbanceObserver,
)
from .disturbances import (
    ObserverSettings as ObserverSettings,
)
from .disturbances import (
    Recorded as Recorded,
)
from .disturbances import (
    RiseObserver as RiseObserver,
)
from .disturbances import (
    Sinusoid as Sinusoid,
)
from .disturbances import (
    SmoothStep as SmoothStep,
)
from .errors import (
    EmptySetError as EmptySetError,
)
from .errors import (
    ModelError as ModelError,
)
from .errors import (
    ScenarioError as ScenarioError,
)
from .errors import (
    SolverError as SolverError,
)
from .errors import (
    UnboundedSetError as UnboundedSetError,
)
from .errors import (
    VcbfError as VcbfError,
)
from .model import (
    ControlAffineModel as ControlAffineModel,
)
from .model import (
    point_position as point_position,
)
from .plants import (
    Blimp as Blimp,
)
from .plants import (
    BlimpController as BlimpController,
)
from .plants import (
    BlimpParameters as BlimpParameters,
)
from .plants import (
    Car as Car,
)
from .plants import (
    CarController as CarController,
)
from .plants import (
    CarParameters as CarParameters,
)
from .plants import (
    StateFeedback as StateFeedback,
)
from .plants import (
    Vehicle as Vehicle,
)
from .safety import (
    METHODS as METHODS,
)
from .safety import (
    Corrections as Corrections,
)
from .safety import (
    FilterSettings as FilterSettings,
)
from .safety import (
    FilterStatus as FilterStatus,
)
from .safety import (
    InputSet as InputSet,
)
from .safety import (
    SafetyFilter as SafetyFilter,
)
from .safety import (
    VolumeBarrier as VolumeBarrier,
)
from .safety import (
    assumptions as assumptions,
)
from .simulation import (
    InputLimits as InputLimits,
)
from .simulation import (
    Obstacle as Obstacle,
)
from .simulation import (
    Scenario as Scenario,
)
from .simulation import (
    load_scenario as load_scenario,
)
from .simulation import (
    make_loop as make_loop,
)
from .simulation import (
    simulate as simulate,
)

__version__: str
