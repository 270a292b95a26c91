"""Scenarios, the loops that they describe, and their simulation."""

from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.fleet import Fleet, make_fleet_loop
from vcbf_drake.simulation.loading import (
    dump_scenario,
    load_fleet,
    load_scenario,
    shipped_scenarios,
)
from vcbf_drake.simulation.loop import make_loop
from vcbf_drake.simulation.obstacle_files import PolygonMap, SpheresFile
from vcbf_drake.simulation.obstacles import BodyPoint, barriers
from vcbf_drake.simulation.result import Result, load_result, read_log_files
from vcbf_drake.simulation.run import (
    check_assumptions,
    simulate,
    simulate_fleet,
)
from vcbf_drake.simulation.scenario import Scenario, validate
from vcbf_drake.simulation.schema import scenario_schema
from vcbf_drake.simulation.sections import (
    BarrierGains,
    Hardware,
    InputLimits,
    Integrator,
    MeasurementNoise,
    Separation,
)

__all__ = [
    "BarrierGains",
    "BodyPoint",
    "Faults",
    "Fleet",
    "Hardware",
    "InputLimits",
    "Integrator",
    "MeasurementNoise",
    "PolygonMap",
    "Result",
    "Scenario",
    "Separation",
    "SpheresFile",
    "barriers",
    "check_assumptions",
    "dump_scenario",
    "load_fleet",
    "load_result",
    "load_scenario",
    "make_fleet_loop",
    "make_loop",
    "read_log_files",
    "scenario_schema",
    "shipped_scenarios",
    "simulate",
    "simulate_fleet",
    "validate",
]
