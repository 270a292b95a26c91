"""What pushes the plant, and what estimates the push."""

from vcbf_drake.disturbances.bounds import Condition, DisturbanceBounds, ErrorBound
from vcbf_drake.disturbances.estimate import DisturbanceEstimate
from vcbf_drake.disturbances.linear_observer import LinearDisturbanceObserver
from vcbf_drake.disturbances.observer import DisturbanceObserver
from vcbf_drake.disturbances.rise_certificate import RiseGains
from vcbf_drake.disturbances.rise_observer import RiseObserver
from vcbf_drake.disturbances.source import (
    BandLimitedNoise,
    Constant,
    DisturbanceSource,
    Recorded,
    Sinusoid,
    SmoothStep,
)

__all__ = [
    "BandLimitedNoise",
    "Condition",
    "Constant",
    "DisturbanceBounds",
    "DisturbanceEstimate",
    "DisturbanceObserver",
    "DisturbanceSource",
    "ErrorBound",
    "LinearDisturbanceObserver",
    "Recorded",
    "RiseGains",
    "RiseObserver",
    "Sinusoid",
    "SmoothStep",
]
