"""How the faults of a scenario are wired into its loop; nothing where there is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    FirstOrderLowPassFilter,
    Saturation,
)

from vcbf_drake.disturbances import DisturbanceObserver, RiseObserver
from vcbf_drake.plants import BlimpParameters, CarParameters
from vcbf_drake.safety import SafetyFilter
from vcbf_drake.simulation.faults import Faults
from vcbf_drake.simulation.killed_process import (
    KilledLinearObserver,
    KilledRiseObserver,
    KilledSafetyFilter,
    Outages,
)
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.sensor_faults import DelayedMeasurement, LostMeasurements
from vcbf_drake.simulation.undeclared_disturbance import UndeclaredDisturbance
from vcbf_drake.simulation.unreliable_filter import UnreliableSafetyFilter


def true_parameters(
    nominal: BlimpParameters | CarParameters, faults: Faults
) -> BlimpParameters | CarParameters:
    """Returns the parameters of the plant that is really there.

    Args:
        nominal: Those of the filter's model.
        faults: What is wrong with them.
    """
    mass, drag = faults.mass, faults.drag
    if isinstance(nominal, CarParameters):
        return replace(nominal, mass=mass * nominal.mass)
    return BlimpParameters(
        mass=mass * nominal.mass,
        added_mass=[mass * each for each in nominal.added_mass],
        drag=[drag * each for each in nominal.drag],
        yaw_inertia=mass * nominal.yaw_inertia,
        yaw_drag=drag * nominal.yaw_drag,
    )


def true_disturbance(
    builder: DiagramBuilder, faults: Faults, declared: OutputPort
) -> OutputPort:
    """Returns the port of the disturbance that really acts.

    Args:
        builder: Holds the source of the declared one.
        faults: What is wrong with it.
        declared: The source's port.
    """
    if not faults.changes_disturbance:
        return declared
    system = UndeclaredDisturbance(declared.size(), faults.disturbance, faults.gusts)
    builder.AddNamedSystem("undeclared_disturbance", system)
    builder.Connect(declared, system.get_input_port())
    return system.get_output_port()


def faulty_measurement(
    builder: DiagramBuilder, scenario: Scenario, state: OutputPort
) -> OutputPort:
    """Returns the port of what reaches filter, observer and controller.

    Args:
        builder: Holds the plant, and its noise.
        scenario: With its faults.
        state: What a sensor without them would deliver.
    """
    faults, period, n = scenario.faults, scenario.period, state.size()
    if any(faults.measurement_bias):
        bias = builder.AddNamedSystem(
            "measurement_bias", ConstantVectorSource(np.array(faults.measurement_bias))
        )
        biased = builder.AddNamedSystem("biased_state", Adder(2, n))
        builder.Connect(state, biased.get_input_port(0))
        builder.Connect(bias.get_output_port(), biased.get_input_port(1))
        state = biased.get_output_port()
    chain: dict[str, LeafSystem] = {}
    if faults.measurement_delay > 0.0:
        chain["delayed_measurement"] = DelayedMeasurement(
            n, period, faults.measurement_delay
        )
    if faults.measurement_loss > 0.0:
        chain["lost_measurements"] = LostMeasurements(
            n, period, faults.measurement_loss, faults.seed
        )
    for name, system in chain.items():
        builder.AddNamedSystem(name, system)
        builder.Connect(state, system.get_input_port())
        state = system.get_output_port()
    return state


def faulty_actuator(
    builder: DiagramBuilder, scenario: Scenario, plant_input: InputPort
) -> InputPort:
    """Returns the port that takes the held input in the plant's place.

    Args:
        builder: Holds the plant.
        scenario: With its faults.
        plant_input: The plant's own port.
    """
    faults, limits = scenario.faults, scenario.input_set
    if faults.actuator_lag > 0.0:
        lag = builder.AddNamedSystem(
            "actuator_lag",
            FirstOrderLowPassFilter(faults.actuator_lag, plant_input.size()),
        )
        builder.Connect(lag.get_output_port(), plant_input)
        plant_input = lag.get_input_port()
    if faults.actuator_limit < 1.0:
        least, most = np.array(limits.lower), np.array(limits.upper)
        saturation = builder.AddNamedSystem(
            "actuator_limit",
            Saturation(faults.actuator_limit * least, faults.actuator_limit * most),
        )
        builder.Connect(saturation.get_output_port(), plant_input)
        plant_input = saturation.get_input_port()
    return plant_input


def filter_class(scenario: Scenario) -> Callable[..., SafetyFilter]:
    """Returns what makes the filter: one that fails, where that is a fault.

    Args:
        scenario: With its faults.
    """
    faults = scenario.faults
    if faults.solver_failure == 0.0 and faults.outage == 0.0:
        return SafetyFilter
    unreliable: dict[str, Any] = {
        "probability": faults.solver_failure,
        "period": scenario.period,
        "seed": faults.seed,
    }
    if faults.outage == 0.0:
        return partial(UnreliableSafetyFilter, **unreliable)
    return partial(KilledSafetyFilter, outages=outages(scenario), **unreliable)


def faulty_observer(
    scenario: Scenario, observer: Callable[..., DisturbanceObserver]
) -> Callable[..., DisturbanceObserver]:
    """Returns what makes the observer: one that starts again, where that is a fault.

    Args:
        scenario: With its faults.
        observer: `RiseObserver` or `LinearDisturbanceObserver`.
    """
    if scenario.faults.outage == 0.0:
        return observer
    killed = KilledRiseObserver if observer is RiseObserver else KilledLinearObserver

    def make(*arguments: Any, **keywords: Any) -> DisturbanceObserver:
        made = killed(*arguments, **keywords)
        made.outages = outages(scenario)
        return made

    return make


def outages(scenario: Scenario) -> Outages:
    """Returns when the filter's process is down.

    Args:
        scenario: With its faults.
    """
    faults = scenario.faults
    return Outages(faults.outage, faults.outage_duration, scenario.period, faults.seed)
