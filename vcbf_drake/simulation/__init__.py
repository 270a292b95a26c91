"""Scenarios, the loop they describe, and what happens when it runs."""

from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.loading import (
    dump_scenario,
    load_scenario,
    shipped_scenarios,
)
from vcbf_drake.simulation.log import read_log_files
from vcbf_drake.simulation.loop import make_loop
from vcbf_drake.simulation.obstacle_files import PolygonMap, SpheresFile
from vcbf_drake.simulation.obstacles import BodyPoint, barriers
from vcbf_drake.simulation.result import Result, load_result
from vcbf_drake.simulation.run import check_assumptions, simulate, step_cpu_time
from vcbf_drake.simulation.scenario import (
    BarrierGains,
    Hardware,
    InputLimits,
    Integrator,
    MeasurementNoise,
    Scenario,
    validate,
)
from vcbf_drake.simulation.schema import scenario_page, scenario_schema

__all__ = [
    "BarrierGains",
    "BodyPoint",
    "Faults",
    "Hardware",
    "InputLimits",
    "Integrator",
    "MeasurementNoise",
    "PolygonMap",
    "Result",
    "Scenario",
    "SpheresFile",
    "barriers",
    "check_assumptions",
    "dump_scenario",
    "load_result",
    "load_scenario",
    "make_loop",
    "read_log_files",
    "scenario_page",
    "scenario_schema",
    "shipped_scenarios",
    "simulate",
    "step_cpu_time",
    "validate",
]
