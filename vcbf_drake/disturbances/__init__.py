"""Disturbance signals and disturbance observers."""

from vcbf_drake.disturbances.bounds import (
    Condition,
    DisturbanceBounds,
    DisturbanceEstimate,
    ErrorBound,
)
from vcbf_drake.disturbances.linear import LinearDisturbanceObserver
from vcbf_drake.disturbances.observer import DisturbanceObserver
from vcbf_drake.disturbances.rise import ObserverSettings, RiseObserver
from vcbf_drake.disturbances.rise_bound import RiseGains
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
    "ObserverSettings",
    "Recorded",
    "RiseGains",
    "RiseObserver",
    "Sinusoid",
    "SmoothStep",
]
