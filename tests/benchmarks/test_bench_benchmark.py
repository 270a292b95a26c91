"""CPU time: pytest --benchmark-only --benchmark-timer=time.process_time."""

import os
import subprocess
import sys

import pytest

from vcbf_drake.studies.bench.problem import instances
from vcbf_drake.studies.bench.tasks import TASKS

INSTANCES = instances(10)
FIRST_TICK = (
    "from vcbf_drake import load_scenario, make_loop\n"
    "loop = make_loop(load_scenario('blimp-multiple-obstacles'))\n"
    "tick = loop.GetSubsystemByName('filter')\n"
    "context = loop.CreateDefaultContext()\n"
    "tick.decision(tick.GetMyContextFromRoot(context))\n"
)


@pytest.mark.parametrize(
    ("task", "route"),
    [(task, route) for task in TASKS for route in task.routes],
    ids=lambda each: each.name,
)
def test_ten_ticks(benchmark, task, route):
    try:
        function = route.make()
    except ImportError:
        pytest.skip(f"{route.package} is not installed")

    def ticks():
        for each in INSTANCES:
            function(*task.arguments(each))

    benchmark(ticks)


@pytest.mark.parametrize("cache", ["cold", "warm"])
def test_first_tick_of_a_new_process(benchmark, tmp_path, cache):
    """Wall time: --benchmark-timer=time.perf_counter."""
    place = "off" if cache == "cold" else str(tmp_path)
    environment = os.environ | {"VCBF_DRAKE_CACHE": place}
    command = [sys.executable, "-c", FIRST_TICK]
    subprocess.run(command, env=environment, check=True)
    benchmark.pedantic(
        subprocess.run, (command,), {"env": environment, "check": True}, rounds=3
    )
