"""Hardware in the loop: a vehicle and its controller as two processes on an LCM bus.

What comes from the bus passes one checked function (`decoding`) and one `Inbox` per
channel before anything sees it. The vehicle's half is `make_vehicle`, the controller's
`make_loop(scenario, hardware=True)`; a process around each lets it run in real time.
"""

from vcbf_drake.hil.bus import DEFAULT_URL, Bus, BusError, check_bus
from vcbf_drake.hil.clock import SimulatedClock, WallClock
from vcbf_drake.hil.command_sender import command_message
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.decoding import (
    MessageFormat,
    Reason,
    Rejection,
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
from vcbf_drake.hil.faults import LinkFaults
from vcbf_drake.hil.hardware_loop import make_hardware_loop
from vcbf_drake.hil.in_process import InProcess
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.log_replay import LogReplay, replay_log, start_log
from vcbf_drake.hil.logged_controller import LoggedController
from vcbf_drake.hil.modes import CommandMode, VehicleMode
from vcbf_drake.hil.outbox import Outbox
from vcbf_drake.hil.plant_process import PlantProcess
from vcbf_drake.hil.vehicle import make_vehicle

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
