"""Every command in a short form, for robots that the package does not know."""

from __future__ import annotations

import json
import os
from pathlib import Path
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from vcbf_drake.cli import app
from vcbf_drake.hil import BusError
from vcbf_drake.hil.bus import check_bus

EXAMPLES = Path(__file__).parents[2] / "examples"
ROBOTS = [str(EXAMPLES / name) for name in ("arm.yaml", "quadrotor_slalom.py")]
URL = f"udpm://239.255.76.67:{9700 + os.getpid() % 1000}?ttl=0"


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-W", "error", "-m", "vcbf_drake", *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)


def output(*arguments: str) -> str:
    """What a command says in this process."""
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0, shown.output
    return shown.output


@pytest.mark.parametrize("robot", ROBOTS)
def test_runs_comparisons_checks_and_studies(robot: str, tmp_path: Path) -> None:
    assert "input authority" in output("check", robot)
    brief = "{duration: 0.4}"
    still = ("--override", brief, "--no-figures")  # What is compared has figures.
    output("run", robot, *still, "--out", f"{tmp_path}/run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["outcome"] == "timeout"
    assert summary["guaranteed"]
    assert (tmp_path / "run" / "replay.html").stat().st_size > 1e6
    two = ("--methods", "robust-cbf-qp,dob-vcbf-qp", "--override", brief)
    output("compare", robot, *two, "--out", f"{tmp_path}/compare")
    assert (tmp_path / "compare" / "replay.html").stat().st_size > 1e6
    vary = ("--vary", "vehicle.mass: !Scale [0.9, 1.1]", "--trials", "2")
    study = ("--methods", "robust-cbf-qp", "--workers", "1", "--override", brief)
    output("monte-carlo", robot, *vary, *study, "--out", f"{tmp_path}/study")
    trials = (tmp_path / "study" / "trials.jsonl").read_text().splitlines()
    assert [json.loads(each)["outcome"] for each in trials[-2:]] == 2 * ["timeout"]


def test_every_command_takes_two_vehicles_or_says_why_not(tmp_path: Path) -> None:
    crossing = str(EXAMPLES / "two_vehicles.yaml")
    assert "eastbound: other vehicles" in output("check", crossing)
    brief = ("--override", "{duration: 0.4}")
    two = ("--methods", "robust-cbf-qp,dob-vcbf-qp", *brief)
    output("compare", crossing, *two, "--out", f"{tmp_path}/compare")
    assert (tmp_path / "compare" / "replay.html").stat().st_size > 1e6
    for method in ("robust-cbf-qp", "dob-vcbf-qp"):
        for name in ("eastbound", "northbound"):
            path = tmp_path / "compare" / method / name / "summary.json"
            assert json.loads(path.read_text())["least_separation"] > 0.8
    output("diagram", crossing, "--out", f"{tmp_path}/diagram")
    drawn = {each.stem for each in (tmp_path / "diagram").glob("*.dot")}
    assert drawn == {"crossing", "eastbound", "northbound", "safety-filter"}
    vary = ("--vary", "vehicles.1.initial_state.1: !Add [-0.2, 0.0]", "--trials", "2")
    study = ("--methods", "cbf-qp", "--workers", "1", *brief)
    output("monte-carlo", crossing, *vary, *study, "--out", f"{tmp_path}/study")
    trials = (tmp_path / "study" / "trials.jsonl").read_text().splitlines()
    found = [json.loads(each) for each in trials]
    assert [each["outcome"] for each in found] == 2 * ["timeout"]
    assert found[0]["min_barrier"] != found[1]["min_barrier"]
    for command in ("plant", "controller", "faults"):
        shown = CliRunner().invoke(app, (command, crossing))
        assert shown.exit_code == 2
        assert shown.output.count("\n") == 1
        assert "2 vehicles (eastbound, northbound), where one is needed" in shown.output


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_plant_and_controller_in_two_processes(robot: str) -> None:
    try:
        check_bus(URL)
    except BusError:
        pytest.skip("no route for multicast: ip route add 224.0.0.0/4 dev lo")
    options = ("--lcm-url", URL, "--duration", "1", "--json")
    sides = [start(side, robot, *options) for side in ("controller", "plant")]
    # A busy machine is late, and the brake has its reasons; what is safe where both are
    # on time shows in one process (tests/hil/test_hil_loop.py).
    controller, plant = (json.loads(each.communicate(timeout=300)[0]) for each in sides)
    assert plant["outcome"] in ("timeout", "collision")
    assert plant["arrived"]["accepted"] > 3
    assert controller["arrived"]["accepted"] > 3
    assert controller["ticks"] > 3
