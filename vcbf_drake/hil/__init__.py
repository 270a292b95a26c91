"""Hardware in the loop: a vehicle and its controller as two processes on an LCM bus.

What comes from the bus passes one checked function (`decoding`) and one `Inbox` per
channel before anything sees it. The vehicle's half is `make_vehicle`, the controller's
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
)
from vcbf_drake.hil.controller_side import command_message, make_hardware_loop
from vcbf_drake.hil.decoding import (
    CommandMode,
    MessageFormat,
    Reason,
    Rejection,
    VehicleMode,
    command_format,
    obstacles_format,
    state_format,
    status_format,
)
from vcbf_drake.hil.event_log import (
    Event,
    EventLog,
    EventLogError,
    EventLogWriter,
    read_event_log,
)
from vcbf_drake.hil.log_replay import LoggedController, LogReplay, replay_log, start_log
from vcbf_drake.hil.mailbox import Inbox, Outbox
from vcbf_drake.hil.processes import ControllerProcess, InProcess, PlantProcess
from vcbf_drake.hil.vehicle_side import make_vehicle

__all__ = [
    "DEFAULT_URL",
    "Bus",
    "BusError",
    "CommandMode",
    "ControllerProcess",
    "Event",
    "EventLog",
    "EventLogError",
    "EventLogWriter",
    "InProcess",
    "Inbox",
    "LinkFaults",
    "LogReplay",
    "LoggedController",
    "MessageFormat",
    "Outbox",
    "PlantProcess",
    "Reason",
    "Rejection",
    "SimulatedClock",
    "VehicleMode",
    "WallClock",
    "check_bus",
    "command_format",
    "command_message",
    "make_hardware_loop",
    "make_vehicle",
    "obstacles_format",
    "read_event_log",
    "replay_log",
    "start_log",
    "state_format",
    "status_format",
]
