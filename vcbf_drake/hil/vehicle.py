"""make_vehicle: a simulated vehicle that speaks LCM, as a Drake diagram."""

from __future__ import annotations

from pydrake.systems.framework import Diagram, DiagramBuilder, TriggerType
from pydrake.systems.primitives import Integrator, LogVectorOutput

from vcbf_drake.barriers import BarrierSet
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.check_timing import check_timing
from vcbf_drake.hil.command_receiver import CommandReceiver
from vcbf_drake.hil.obstacle_sender import ObstacleSender
from vcbf_drake.hil.state_sender import StateSender
from vcbf_drake.hil.timeline import Timeline
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.simulation.loop import (
    LOG_PREFIX,
    add_collision_monitor,
    add_simulated_plant,
)
from vcbf_drake.simulation.parts import barriers, make_plant
from vcbf_drake.simulation.scenario import Scenario


def make_vehicle(scenario: Scenario, bus: Bus, timeline: Timeline) -> Diagram:
    """Returns a scenario's plant and disturbance behind an LCM bus.

    The systems are named plant, disturbance, command_receiver, input_integral and
    state_sender; ``log_path`` and ``log_mode`` record the true state and the vehicle's
    mode at every integrator step. It ends a simulation at a collision.

    Args:
        scenario: A validated scenario.
        bus: Carries states out and commands in.
        timeline: Ties the diagram's time to the bus's clock.

    Raises:
        ScenarioError: A time limit is shorter than the control period.
    """
    check_timing(scenario)
    builder = DiagramBuilder()
    simulated = add_simulated_plant(builder, scenario)
    plant, measured = simulated.plant, simulated.state
    model = ControlAffineModel.from_system(make_plant(scenario))
    receiver = builder.AddNamedSystem(
        "command_receiver",
        CommandReceiver(
            bus, model, scenario.input_set.input_set(), scenario.hardware, timeline
        ),
    )
    integral = builder.AddNamedSystem("input_integral", Integrator(model.num_inputs))
    sender = builder.AddNamedSystem(
        "state_sender",
        StateSender(
            bus,
            model.num_states,
            model.num_inputs,
            scenario.period,
            receiver.inbox,
            timeline,
        ),
    )
    builder.AddNamedSystem("obstacle_sender", ObstacleSender(bus, scenario))
    applied, mode = receiver.GetOutputPort("input"), receiver.GetOutputPort("mode")
    builder.Connect(measured, receiver.GetInputPort("state"))
    builder.Connect(applied, simulated.input)
    builder.Connect(applied, integral.get_input_port())
    builder.Connect(measured, sender.GetInputPort("state"))
    builder.Connect(integral.get_output_port(), sender.GetInputPort("input_integral"))
    builder.Connect(mode, sender.GetInputPort("mode"))
    add_collision_monitor(builder, plant, BarrierSet(model, barriers(scenario)))
    logged = {"path": plant.GetOutputPort("state"), "mode": mode}
    for name, port in logged.items():
        log = LogVectorOutput(port, builder, {TriggerType.kPerStep})
        log.set_name(LOG_PREFIX + name)
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_vehicle")
    return diagram
