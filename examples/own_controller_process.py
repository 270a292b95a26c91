"""Your controller in a process of its own, in the place of ``vcbf-drake controller``.

The vehicle is ``vcbf-drake plant car-avoidance``; replace it by your own vehicle, if it
speaks the same messages. This program is the complete other side. It uses no Drake
systems: it receives states that passed every check, and answers each with a command. If
it falls silent, the vehicle brakes by itself.

    python examples/own_controller_process.py
"""

import argparse
import json
import math
import os
import subprocess
import sys

from pydrake.lcm import DrakeLcm

from vcbf_drake.hil import (
    Bus,
    BusError,
    CommandMode,
    Inbox,
    VehicleMode,
    check_bus,
    command_format,
    command_message,
    state_format,
)

WAY = [(2.5, -0.6), (5.0, 0.0)]  # Past the disc, then to the target [m].
MASS, TOP_SPEED = 2.0, 1.2  # In kg and m/s.


class WaypointDriver:
    """Drives a car from point to point; an integral learns what pushes it."""

    def __init__(self) -> None:
        self.way = list(WAY)
        self.push = 0.0  # The estimate, in N.

    def input(self, x: float, y: float, speed: float, heading: float, dt: float):
        """The force [N] and the turn rate [rad/s] for a state; dt since the last."""
        if len(self.way) > 1 and math.dist((x, y), self.way[0]) < 0.3:
            self.way.pop(0)
        dx, dy = self.way[0][0] - x, self.way[0][1] - y
        bearing = math.remainder(math.atan2(dy, dx) - heading, 2.0 * math.pi)
        left = math.hypot(dx, dy) * math.cos(bearing)
        last = len(self.way) == 1
        error = max(-TOP_SPEED, min(left if last else TOP_SPEED, TOP_SPEED)) - speed
        self.push -= 3.0 * error * dt
        turn = 2.0 * bearing if math.hypot(dx, dy) > 0.1 else 0.0
        return [3.0 * MASS * error - self.push, max(-3.0, min(turn, 3.0))]


def drive(url: str) -> None:
    """Answers every state with a command, until the vehicle ends."""
    bus = Bus(DrakeLcm(url), name="car-avoidance")
    driver, last = WaypointDriver(), None
    states = Inbox(bus, state_format(num_states=4, num_inputs=2), max_age=0.1)
    channel = command_format(num_inputs=2).channel
    while last is None or last.mode != VehicleMode.ENDED:
        if not bus.wait(bus.clock.utime() + 30_000_000):
            sys.exit("no vehicle spoke for 30 s")
        state = states.newest
        if state is last:
            continue
        dt = state.time - last.time if last else 0.0
        u = driver.input(*state.state, dt)
        bus.send(channel, command_message(u, CommandMode.APPLY, state))
        last = state
    print(f"my controller answered {bus.sent[channel]} states; {states.lost} were lost")


def main() -> None:
    """Starts the vehicle, drives it, and prints what it says at the end."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="2 s only, for a check")
    duration = "2" if parser.parse_args().short else "8"
    # A port of its own, beside whatever else is on this computer.
    url = f"udpm://239.255.76.67:{8700 + os.getpid() % 1000}?ttl=0"
    try:
        check_bus(url)
    except BusError as error:
        print(error)
        return
    command = [sys.executable, "-m", "vcbf_drake", "plant", "car-avoidance"]
    options = ["--lcm-url", url, "--duration", duration, "--json"]
    vehicle = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
    drive(url)
    text, _ = vehicle.communicate(timeout=60.0)
    report = json.loads(text)
    print(
        f"the car: {report['outcome']}, {report['final_distance']:.2f} m from the"
        f" target, min h {report['min_barrier']:.2f}"
    )


if __name__ == "__main__":
    main()
