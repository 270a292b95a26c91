"""A robot of your own on the bus: a boat in C++, its controller and filter in Drake.

The boat of own_plant.py again, but its vehicle side is a C++ program with stock LCM
(`boat/boat.cpp`; built here by `boat/Makefile` if g++ and liblcm-dev are installed).
`control` has all parts of a controller's process: the link to the vehicle in place of a
plant, your controller, the filter, and the sender of commands.

    python examples/boat_controller.py
"""

import argparse
import os
from pathlib import Path
import subprocess
import sys
import tempfile

import numpy as np
from own_plant import BUOYS, GOAL, Boat
from pydrake.lcm import DrakeLcm
from pydrake.systems.controllers import PidController
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from vcbf_drake import AddSafetyFilter, ControlAffineModel, InputSet
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.hil import Bus, BusError, ControllerProcess, VehicleLink, check_bus

HERE = Path(__file__).parent


def control(url: str, name: str) -> ControllerProcess:
    """Controls the boat until it ends; returns the process, for its report."""
    bus, builder = Bus(DrakeLcm(url), name=name), DiagramBuilder()
    model = ControlAffineModel.from_system(Boat(), "thrust", "gust")
    link = VehicleLink(builder, bus, model, period=0.02)
    pilot = builder.AddSystem(PidController([4, 4], [0, 0], [14, 14]))
    goal = builder.AddSystem(ConstantVectorSource([*GOAL, 0.0, 0.0]))
    builder.Connect(link.state, pilot.get_input_port_estimated_state())
    builder.Connect(goal.get_output_port(), pilot.get_input_port_desired_state())
    safety = AddSafetyFilter(
        builder,
        plant=None,
        model=model,
        state=link.state,
        applied_input=link.applied_input,
        reference=pilot.get_output_port_control(),
        barriers=[buoy.barrier(gains=[3.0, 2.0]) for buoy in BUOYS],
        input_set=InputSet.box([-4.0, -4.0], [4.0, 4.0]),
        bounds=DisturbanceBounds(0.15, 0.15, 0.15),
    )
    link.answer(safety, pilot.get_output_port_control())
    process = ControllerProcess(builder.Build(), bus)
    process.tell = print
    clearances = []
    process.tick_taps.append(
        lambda context: clearances.append(
            safety.filter.GetOutputPort("barriers")
            .Eval(safety.filter.GetMyContextFromRoot(context))
            .min()
        )
    )
    process.run(patience=30.0)
    print(f"min h: {np.min(clearances, initial=np.inf):.3f} m")
    return process


def build(directory: str) -> Path | None:
    """Builds the boat; None where the tools for it are missing."""
    command = ["make", "-C", str(HERE / "boat"), f"OUT={directory}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return Path(directory) / "boat" if done.returncode == 0 else None


def main() -> None:
    """Builds and starts the boat, and controls it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="4 s only, for a check")
    duration = "4" if parser.parse_args().short else "24"
    # A port of its own, beside whatever else is on this computer.
    url = f"udpm://239.255.76.67:{6700 + os.getpid() % 1000}?ttl=0"
    with tempfile.TemporaryDirectory() as directory:
        boat = build(directory)
        if boat is None:
            print("skipped: the boat needs make, g++, liblcm-dev and liblcm-bin")
            return
        try:
            check_bus(url)
        except BusError as error:
            print(error)
            return
        vehicle = subprocess.Popen([boat, url, "boat", duration])
        report = control(url, "boat").report()
        if vehicle.wait(timeout=60.0):
            sys.exit("the boat failed")
    print(f"infeasible ticks: {report['infeasible_ticks']}, of {report['ticks']}")
    print(f"refuted: {', '.join(report['findings']) or 'nothing'}")
    print(f"states lost: {report['arrived']['lost']}")


if __name__ == "__main__":
    main()
