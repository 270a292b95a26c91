"""A vehicle and its controller in two processes, over good and bad links.

Runs the commands that it prints, each run in real time:

* good: no faults;
* lossy: one message in five is lost, both ways;
* late: every message is 30 ms late, plus or minus 10 ms, both ways;
* killed: the controller is killed in mid-flight; half a second later another one, which
  is already loaded and has no information about the flight, takes over.

    python examples/hardware_faults.py
"""

import argparse
import json
import os
import subprocess
import sys
import time

from pydrake.lcm import DrakeLcm

from vcbf_drake import load_scenario
from vcbf_drake.hil import Bus, BusError, check_bus, controller_of
from vcbf_drake.hil.messages import vcbf_state

SCENARIO = "blimp-multiple-obstacles"
COMMAND = [sys.executable, "-m", "vcbf_drake"]
FAULTS = {
    "good": [],
    "lossy": ["--drop", "0.2"],
    "late": ["--delay", "0.03", "--jitter", "0.01"],
    "killed": [],
}
RATE = 100.0  # In Hz.
KILLED_AT, DEAD_FOR = 6.0, 0.5  # In seconds.


def start(side: str, url: str, options: list[str]) -> subprocess.Popen:
    """Starts one of the two processes."""
    arguments = [side, SCENARIO, "--lcm-url", url, "--json", *options]
    print("  vcbf-drake", *arguments)
    return subprocess.Popen(
        [*COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def report(process: subprocess.Popen) -> dict:
    """Waits for a process; what it says at its end."""
    text, _ = process.communicate(timeout=120.0)
    if process.returncode != 0:
        sys.exit(f"a process ended with status {process.returncode}")
    return json.loads(text)


def load_standby(url: str) -> subprocess.Popen:
    """Starts a controller that is loaded and waits for a line before it speaks."""
    standby = subprocess.Popen(
        [sys.executable, __file__, "--standby", url],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    standby.stdout.readline()
    return standby


def stand_by(url: str) -> None:
    """The process of a standby: a controller without its first message."""
    scenario = load_scenario(SCENARIO, {"period": 1.0 / RATE})
    process = controller_of(scenario, Bus(DrakeLcm(url), name=SCENARIO))
    print("ready", flush=True)
    sys.stdin.readline()
    process.run()
    print(json.dumps(process.report()))


def wait_for_flight(url: str, instant: float) -> None:
    """Listens to the vehicle until a time of its flight [s]."""
    lcm, heard = DrakeLcm(url), [0.0]
    lcm.Subscribe(
        f"VCBF_STATE/{SCENARIO}",
        lambda data: heard.append(vcbf_state.decode(data).time),
    )
    while heard[-1] < instant:
        lcm.HandleSubscriptions(100)


def kill_and_replace(
    url: str, controller: subprocess.Popen, standby: subprocess.Popen
) -> subprocess.Popen:
    """Kills the controller in mid-flight; the standby takes over."""
    wait_for_flight(url, KILLED_AT)
    print("  kill -9 CONTROLLER; sleep 0.5; the standby takes over")
    controller.kill()
    controller.wait()
    time.sleep(DEAD_FOR)
    standby.stdin.write("go\n")
    standby.stdin.flush()
    return standby


def fly(case: str, url: str, options: list[str]) -> None:
    """Flies once and prints what both sides saw."""
    print(case)
    killed = case == "killed"
    controller = start("controller", url, options)
    standby = load_standby(url) if killed else None
    plant = start("plant", url, options)
    if standby is not None:
        controller = kill_and_replace(url, controller, standby)
    show("vehicle", report(plant))
    show("controller", report(controller))


def show(side: str, found: dict) -> None:
    """Prints one side's numbers, and what it did when."""
    link, trip = found["arrived"], found["round_trip_ms"]
    if side == "vehicle":
        reached = found["reached_at"]
        when = "" if reached is None else f" at {reached:.1f} s"
        print(f"  vehicle: {found['outcome']}{when}, min h {found['min_barrier']:.2f}")
    print(
        f"  {side}: round trip {trip['median']:.1f} ms, p99 {trip['p99']:.1f} ms;"
        f" {link['accepted']} accepted, {link['lost']} lost, {link['late']} late;"
        f" {found['deadlines_missed']} periods missed"
    )
    for change in found["changes"][:8]:
        reason = f" ({change['reason']})" if change["reason"] else ""
        print(f"    {change['time']:6.2f} s  {change['mode']}{reason}")


def main() -> None:
    """Flies every case, or the first one for a moment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="2 s only, for a check")
    parser.add_argument("--case", choices=FAULTS, help="only this one")
    parser.add_argument("--standby", metavar="URL", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.standby:
        stand_by(arguments.standby)
        return
    # A port of its own, beside whatever else is on this computer.
    url = f"udpm://239.255.76.67:{7700 + os.getpid() % 1000}?ttl=0"
    try:
        check_bus(url)
    except BusError as error:
        print(error)
        return
    length = ["--duration", "2"] if arguments.short else ["--rate", str(RATE)]
    case = "good" if arguments.short else arguments.case
    for each in [case] if case else FAULTS:
        fly(each, url, [*length, *FAULTS[each]])


if __name__ == "__main__":
    main()
