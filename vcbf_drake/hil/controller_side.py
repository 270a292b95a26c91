"""The controller's side of the bus as Drake systems: states in, commands out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    State,
)

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import (
    CommandMode,
    VehicleMode,
    command_format,
    state_format,
    status_format,
)
from vcbf_drake.hil.mailbox import Inbox, Outbox
from vcbf_drake.hil.messages import vcbf_command, vcbf_state, vcbf_status
from vcbf_drake.hil.prediction import StatePredictor
from vcbf_drake.hil.timing import RoundTrip, check_timing
from vcbf_drake.hil.watchdogs import ObstacleWatch, StateWatchdog, Verdict
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import (
    AddedSafetyFilter,
    FilterStatus,
    SafetyFilter,
    unpack_feasible_set,
)
from vcbf_drake.simulation.fault_systems import lose_answers
from vcbf_drake.simulation.loop import add_controller_and_filter
from vcbf_drake.simulation.parts import make_observer, make_plant, make_source
from vcbf_drake.simulation.scenario import Scenario


class StateStamp(NamedTuple):
    """Which state it is.

    Attributes:
        session: The sender's session [us].
        sequence: Its number there.
        utime: When it was sent [us].
        time: When it was measured, since the motion began [s].
    """

    session: float
    sequence: float
    utime: float
    time: float


@dataclass(frozen=True)
class _Measured:
    """The last state that was taken over, and what goes with it.

    Attributes:
        message: The state's message.
        applied_input: The mean input that was applied before it.
        delays: Its delay, and that of the last command that the vehicle tells of [s].
    """

    message: Any
    applied_input: Array
    delays: Array


class StateReceiver(LeafSystem):
    """Takes the place of a plant: its outputs are what the vehicle said last.

    .. pydrake_system::

        name: StateReceiver
        output_ports:
        - state
        - applied_input
        - stamp
        - delays

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the newest measured state; zeros before the first |
    | ``applied_input`` | m | the mean of what was applied since the state before |
    | ``stamp`` | 4 | what that state's message says, a `StateStamp`; nan before |
    | ``delays`` | 2 | the state's, and the last command's that it tells of [s] |

    Messages are taken over at the beginning of a simulator's step, or at a forced
    event; between events the outputs are constant.

    Args:
        bus: Where states come from.
        num_states: n.
        num_inputs: m.
        max_age: How old a state may be when it arrives [s].

    Attributes:
        inbox: What arrived.
        round_trip: From sending a command to learning that it came.
    """

    def __init__(
        self, bus: Bus, num_states: int, num_inputs: int, max_age: float
    ) -> None:
        super().__init__()
        self.round_trip = RoundTrip()
        self._bus = bus
        self._sizes = num_states, num_inputs
        self._last_command = -1
        self.inbox = Inbox(
            bus, state_format(num_states, num_inputs), max_age, self._take_times
        )
        # A tuple of the message or of none: newer pydrake's values are never None.
        index = self.DeclareAbstractState(AbstractValue.Make(()))
        self._measured_index = index
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        self.DeclareForcedUnrestrictedUpdateEvent(self._take_over)
        needs = {self.abstract_state_ticket(index)}
        self.DeclareVectorOutputPort("state", num_states, self._calc_state, needs)
        self.DeclareVectorOutputPort("delays", 2, self._calc_delays, needs)
        self.DeclareVectorOutputPort(
            "applied_input", num_inputs, self._calc_applied_input, needs
        )
        size = len(StateStamp._fields)
        self.DeclareVectorOutputPort("stamp", size, self._calc_stamp, needs)

    def message(self, context: Context) -> Any:
        """Returns the message that the outputs show, None before the first."""
        measured = self._measured(context)
        return None if measured is None else measured.message

    def has_news(self, context: Context) -> bool:
        """Returns whether a newer message has come than the outputs show."""
        shown, newest = self.message(context), self.inbox.newest
        # A context holds copies: they are told apart by their numbers.
        return newest is not None and (
            shown is None
            or (newest.session, newest.sequence) != (shown.session, shown.sequence)
        )

    def time(self, context: Context) -> float:
        """Returns the vehicle's time of the state, 0 before the first [s]."""
        measured = self._measured(context)
        return 0.0 if measured is None else float(measured.message.time)

    def _measured(self, context: Context) -> _Measured | None:
        held: tuple[_Measured, ...] = context.get_abstract_state(
            self._measured_index
        ).get_value()
        return held[0] if held else None

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        if not self.has_news(context):
            return EventStatus.DidNothing()
        last, newest = self._measured(context), self.inbox.newest
        applied = np.zeros(self._sizes[1])
        if last is not None and newest.time > last.message.time:
            change = np.subtract(newest.input_integral, last.message.input_integral)
            applied = change / (newest.time - last.message.time)
        state.get_mutable_abstract_state(self._measured_index).set_value(
            (_Measured(newest, applied, self._measured_delays()),)
        )
        return EventStatus.Succeeded()

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        zeros = np.zeros(self._sizes[0])
        output.SetFromVector(zeros if measured is None else measured.message.state)

    def _calc_applied_input(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        zeros = np.zeros(self._sizes[1])
        output.SetFromVector(zeros if measured is None else measured.applied_input)

    def _calc_stamp(self, context: Context, output: BasicVector) -> None:
        message = self.message(context)
        output.SetFromVector(
            [
                math.nan if message is None else getattr(message, name)
                for name in StateStamp._fields
            ]
        )

    def _calc_delays(self, context: Context, output: BasicVector) -> None:
        measured = self._measured(context)
        output.SetFromVector(np.zeros(2) if measured is None else measured.delays)

    def _measured_delays(self) -> Array:
        """The delays [s]; zeros while the vehicle does not follow our commands."""
        state = self.inbox.newest
        is_ours = state.command_utime >= self._bus.session
        if state.mode != VehicleMode.FOLLOWING or not is_ours:
            return np.zeros(2)
        state_delay = self.inbox.received_at - state.utime_measured
        command_delay = state.utime - state.command_age - state.command_utime
        return 1e-6 * np.array([state_delay, command_delay])

    def _take_times(self, message: Any, now: int) -> None:
        """Notes the round trip of a command that the vehicle mentions first now."""
        is_ours = message.command_utime >= self._bus.session
        if is_ours and message.command_sequence > self._last_command:
            self._last_command = message.command_sequence
            self.round_trip.add(now - message.command_utime - message.command_age)


class CommandSender(LeafSystem):
    """Publishes what the vehicle is to apply, and beside it what the filter did.

    .. pydrake_system::

        name: CommandSender
        input_ports:
        - input
        - reference
        - slack
        - volume
        - barriers
        - status
        - feasible_set
        - estimate
        - stamp

    `input` is the held input; everything else is sampled at the ticks. It sends
    periodically and at forced events, from the first tick on. A `StateWatchdog` says
    whether the input may be applied. An infeasible tick whose policy is ``stop`` asks
    for the vehicle's fallback, too, and so do obstacles that the filter does not know.

    Args:
        bus: Where to.
        safety_filter: The filter whose ports are connected.
        num_disturbances: q of the observer.
        period: The control period [s].
        states: The states that arrived, for the status.
        watchdog: Looks at their age.
        obstacles: Compares the vehicle's with those of the filter.
        method: The filter's name.

    Attributes:
        ending: Whether the controller is about to end.
        last_status: The status that was sent last, None before the first.
    """

    def __init__(
        self,
        bus: Bus,
        safety_filter: SafetyFilter,
        num_disturbances: int,
        period: float,
        states: Inbox,
        watchdog: StateWatchdog,
        obstacles: ObstacleWatch,
        method: str,
    ) -> None:
        super().__init__()
        self.ending = False
        self.last_status: vcbf_status | None = None
        self._filter, self._states, self._watchdog = safety_filter, states, watchdog
        self._obstacles, self._method = obstacles, method
        m, n_barriers = safety_filter.model.num_inputs, safety_filter.barrier_set.size
        self._commands = Outbox(bus, command_format(m).channel)
        self._statuses = Outbox(
            bus, status_format(m, n_barriers, num_disturbances).channel
        )
        self._input = self.DeclareVectorInputPort("input", m)
        sizes = {
            "reference": m,
            "slack": 1,
            "volume": 1,
            "barriers": n_barriers,
            "status": 1,
            "feasible_set": safety_filter.GetOutputPort("feasible_set").size(),
            "estimate": DisturbanceEstimate.packed_size(num_disturbances),
            "stamp": len(StateStamp._fields),
        }
        self._sampled = [
            self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        ]
        self._ends = dict(zip(sizes, np.cumsum(list(sizes.values())), strict=True))
        self._sizes = sizes
        self.DeclareDiscreteState(np.full(sum(sizes.values()), np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def states_are_old(self) -> bool:
        """Returns whether the newest state is too old to act on."""
        return self._watchdog.verdict().mode is not CommandMode.APPLY

    def verdict(self, context: Context) -> Verdict:
        """Returns what is asked of the vehicle now, and why."""
        if self.ending:
            return Verdict(CommandMode.END, "the controller ends")
        if self._obstacles.difference:
            return Verdict(CommandMode.FALLBACK, self._obstacles.difference)
        verdict = self._watchdog.verdict()
        stops = self._filter.settings.infeasible == "stop"
        if verdict.mode is CommandMode.APPLY and stops:
            conflicts = self.conflicts(context)
            if conflicts:
                reason = f"no input satisfies {', '.join(conflicts)}"
                return Verdict(CommandMode.FALLBACK, reason)
        return verdict

    def conflicts(self, context: Context) -> tuple[str, ...]:
        """Returns the rows that excluded each other at the last tick, by name."""
        sample = self._sample_of(context)
        if sample["status"][0] != FilterStatus.INFEASIBLE:
            return ()
        packed = unpack_feasible_set(
            sample["feasible_set"], self._filter.num_rows, self._filter.model.num_inputs
        )
        return self._filter.conflicting_rows(packed.A, packed.b)

    def _sample(self, context: Context, discrete: DiscreteValues) -> None:
        discrete.set_value(np.concatenate([p.Eval(context) for p in self._sampled]))

    def _sample_of(self, context: Context) -> dict[str, Array]:
        values = context.get_discrete_state_vector().CopyToVector()
        return {
            name: values[end - self._sizes[name] : end]
            for name, end in self._ends.items()
        }

    def _send(self, context: Context) -> None:
        sample = self._sample_of(context)
        state = StateStamp(*sample["stamp"].tolist())
        if math.isnan(state.sequence):  # There was no tick yet.
            return
        verdict, u = self.verdict(context), self._input.Eval(context)
        self._commands.send(command_message(u, verdict.mode, state))
        status = self._status(sample, u, state)
        status.mode, status.reason = int(verdict.mode), verdict.reason
        status.conflicts = list(self.conflicts(context))
        status.num_conflicts = len(status.conflicts)
        self._statuses.send(status)
        self.last_status = status

    def _status(
        self, sample: dict[str, Array], u: Array, state: StateStamp
    ) -> vcbf_status:
        message = vcbf_status()
        message.method = self._method
        message.state_sequence, message.time = int(state.sequence), state.time
        message.state_age = self._watchdog.state_age()
        message.filter_status = int(sample["status"][0])
        message.num_inputs, message.input = len(u), u.tolist()
        message.reference = sample["reference"].tolist()
        message.slack = float(sample["slack"][0])
        message.volume = float(sample["volume"][0])
        message.barriers = sample["barriers"].tolist()
        message.num_barriers = len(message.barriers)
        estimate = DisturbanceEstimate.unpack(sample["estimate"])
        message.disturbance_estimate = estimate.disturbance.tolist()
        message.num_disturbances = len(message.disturbance_estimate)
        message.error_bound = float(estimate.error_bound)
        message.states_accepted = self._states.accepted
        message.states_lost = self._states.lost
        message.states_late = self._states.late
        message.states_rejected = self._states.rejected
        return message


def command_message(
    u: Sequence[float] | Array, mode: CommandMode, state: StateStamp | vcbf_state
) -> vcbf_command:
    """Returns the command to apply an input, or zeros with a mode that applies none.

    Args:
        u: The input, shape (m,).
        mode: What the vehicle is to do.
        state: The state that it answers: its stamp, or its message.
    """
    message = vcbf_command()
    message.state_session = int(state.session)
    message.state_sequence = int(state.sequence)
    message.state_utime = int(state.utime)
    message.mode = int(mode)
    applies = mode in (CommandMode.APPLY, CommandMode.HOLD)
    message.num_inputs = len(u)
    message.input = [float(each) if applies else 0.0 for each in u]
    return message


def make_hardware_loop(scenario: Scenario, bus: Bus | None = None) -> Diagram:
    """Returns controller, filter, hold and observer between two ends of an LCM bus.

    The systems are those of `make_loop`, with state_receiver and command_sender where
    plant and disturbance were. The observer has the control period, for states come no
    faster, and is told what the vehicle really applied.
    It bridges lost states up to `Hardware.longest_interval` and begins anew after
    longer gaps; the filter's margin for the hold covers that interval, too.

    A simulator drives the diagram as any other. `ControllerProcess` drives it tick by
    tick instead, whenever a state comes.

    Args:
        scenario: A validated scenario.
        bus: Carries states in and commands out; LCM's default one if None.

    Raises:
        ScenarioError: A time limit is shorter than the control period.
    """
    bus = bus or Bus()
    check_timing(scenario)
    builder = DiagramBuilder()
    model = ControlAffineModel.from_system(make_plant(scenario))
    bounds, settings = make_source(scenario).bounds, scenario.hardware
    receiver = builder.AddNamedSystem(
        "state_receiver",
        StateReceiver(bus, model.num_states, model.num_inputs, settings.max_state_age),
    )
    measured = receiver.GetOutputPort("state")
    predictor = _add_predictor(builder, scenario, model) if settings.predict else None
    observer = builder.AddNamedSystem(
        "filter_observer",
        make_observer(
            scenario,
            model,
            bounds,
            period=scenario.period,
            longest_interval=settings.longest_interval,
        ),
    )
    # What was measured, where the filter acts on a prediction of it.
    builder.Connect(measured, observer.GetInputPort("state"))
    controller, loop = add_controller_and_filter(
        builder,
        scenario,
        model,
        bounds,
        state=predictor.get_output_port() if predictor else measured,
        observer=observer,
        applied_input=receiver.GetOutputPort("applied_input"),
    )
    if predictor is not None:
        _connect_predictor(builder, predictor, receiver, loop)
    watchdog = StateWatchdog(receiver.inbox, bus.clock, settings)
    sender = builder.AddNamedSystem(
        "command_sender",
        CommandSender(
            bus,
            loop.filter,
            model.num_disturbances,
            scenario.period,
            receiver.inbox,
            watchdog,
            ObstacleWatch(bus, scenario),
            scenario.method,
        ),
    )
    builder.Connect(loop.hold.get_output_port(), sender.GetInputPort("input"))
    builder.Connect(
        controller.GetOutputPort("reference"), sender.GetInputPort("reference")
    )
    for name in ("slack", "volume", "barriers", "status", "feasible_set"):
        builder.Connect(loop.filter.GetOutputPort(name), sender.GetInputPort(name))
    builder.Connect(
        loop.observer.GetOutputPort("estimate"), sender.GetInputPort("estimate")
    )
    builder.Connect(receiver.GetOutputPort("stamp"), sender.GetInputPort("stamp"))
    lose_answers(builder, scenario, loop)
    diagram = builder.Build()
    diagram.set_name(f"{scenario.name}_controller")
    return diagram


def _add_predictor(
    builder: DiagramBuilder, scenario: Scenario, model: ControlAffineModel
) -> StatePredictor:
    longest = scenario.hardware.max_state_age
    predictor: StatePredictor = builder.AddNamedSystem(
        "state_predictor", StatePredictor(model, scenario.period, longest)
    )
    return predictor


def _connect_predictor(
    builder: DiagramBuilder,
    predictor: StatePredictor,
    receiver: StateReceiver,
    loop: AddedSafetyFilter,
) -> None:
    ports = {
        "state": receiver.GetOutputPort("state"),
        "delays": receiver.GetOutputPort("delays"),
        "held_input": loop.hold.get_output_port(),
        "disturbance_estimate": loop.observer.GetOutputPort("disturbance_estimate"),
    }
    for name, port in ports.items():
        builder.Connect(port, predictor.GetInputPort(name))
