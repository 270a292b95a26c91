"""StateSender: publishes a simulated vehicle's state."""

from __future__ import annotations

from pydrake.systems.framework import Context, LeafSystem

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import state_format
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.messages import vcbf_state
from vcbf_drake.hil.modes import VehicleMode
from vcbf_drake.hil.outbox import Outbox
from vcbf_drake.hil.timeline import Timeline


class StateSender(LeafSystem):
    """Publishes the measured state, periodically and at forced events.

    .. pydrake_system::

        name: StateSender
        input_ports:
        - state
        - input_integral
        - mode

    Args:
        bus: Where to.
        num_states: n.
        num_inputs: m.
        period: Time between messages [s].
        commands: The commands that arrived.
        timeline: Tells the time of the context.

    Attributes:
        ending: Whether the vehicle is about to end.
    """

    def __init__(
        self,
        bus: Bus,
        num_states: int,
        num_inputs: int,
        period: float,
        commands: Inbox,
        timeline: Timeline,
    ) -> None:
        super().__init__()
        self.ending = False
        self._clock, self._commands, self._timeline = bus.clock, commands, timeline
        self._outbox = Outbox(bus, state_format(num_states, num_inputs).channel)
        self._state = self.DeclareVectorInputPort("state", num_states)
        self._integral = self.DeclareVectorInputPort("input_integral", num_inputs)
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def _send(self, context: Context) -> None:
        message, command = vcbf_state(), self._commands.newest
        mode = VehicleMode(int(self._mode.Eval(context)[0]))
        message.mode = VehicleMode.ENDED if self.ending else mode
        message.time = context.get_time()
        message.utime_measured = self._timeline.utime(message.time)
        if message.mode in (VehicleMode.WAITING, VehicleMode.ENDED):
            # Its time stands still, as it does: what is true now is measured now.
            message.utime_measured = self._clock.utime()
        message.command_sequence = -1
        if command is not None:
            message.command_sequence = command.sequence
            message.command_utime = command.utime
            message.command_age = self._clock.utime() - self._commands.received_at
        message.state = self._state.Eval(context).tolist()
        message.num_states = len(message.state)
        message.input_integral = self._integral.Eval(context).tolist()
        message.num_inputs = len(message.input_integral)
        self._outbox.send(message)
