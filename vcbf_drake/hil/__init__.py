"""Hardware in the loop: a vehicle and its controller as two processes on an LCM bus.

A message's way: `bus` (bytes), `formats` (checked), `inbox` (accepted, by its sender,
order and clock). The vehicle's half is `make_vehicle`, the controller's
`make_hardware_loop`; a process around each lets it run in real time.
"""

from vcbf_drake.hil.bus import (
    DEFAULT_URL,
    Bus,
    BusError,
    LinkFaults,
    SimulatedClock,
    WallClock,
    check_bus,
    open_bus,
    read_key,
    vehicle_name,
)
from vcbf_drake.hil.command_sender import CommandSender, command_message
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.controller_side import (
    InProcess,
    VehicleLink,
    controller_of,
    make_hardware_loop,
)
from vcbf_drake.hil.event_log import (
    Event,
    EventLogError,
    EventLogWriter,
    carries_scenario,
    read_event_log,
    start_log,
)
from vcbf_drake.hil.formats import (
    CommandMode,
    MessageFormat,
    Reason,
    Rejection,
    VehicleMode,
    command_format,
    obstacles_format,
    state_format,
)
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.log_replay import LoggedController, LogReplay, replay_log
from vcbf_drake.hil.prediction import LiveAudit, StatePredictor
from vcbf_drake.hil.processes import EXIT_STATUSES, PlantProcess, say_farewell
from vcbf_drake.hil.receivers import (
    ObstacleReceiver,
    StateReceiver,
    Verdict,
    Watchdog,
)
from vcbf_drake.hil.vehicle_side import make_vehicle

__all__ = [
    "DEFAULT_URL",
    "EXIT_STATUSES",
    "Bus",
    "BusError",
    "CommandMode",
    "CommandSender",
    "ControllerProcess",
    "Event",
    "EventLogError",
    "EventLogWriter",
    "InProcess",
    "Inbox",
    "LinkFaults",
    "LiveAudit",
    "LogReplay",
    "LoggedController",
    "MessageFormat",
    "ObstacleReceiver",
    "PlantProcess",
    "Reason",
    "Rejection",
    "SimulatedClock",
    "StatePredictor",
    "StateReceiver",
    "VehicleLink",
    "VehicleMode",
    "Verdict",
    "WallClock",
    "Watchdog",
    "carries_scenario",
    "check_bus",
    "command_format",
    "command_message",
    "controller_of",
    "make_hardware_loop",
    "make_vehicle",
    "obstacles_format",
    "open_bus",
    "read_event_log",
    "read_key",
    "replay_log",
    "say_farewell",
    "start_log",
    "state_format",
    "vehicle_name",
]
