"""CPU time: pytest --benchmark-only --benchmark-timer=time.process_time."""

import pytest

from vcbf_drake import load_scenario, simulate
from vcbf_drake.studies.tick_times import STAGES, tick_times


@pytest.mark.parametrize("method", ["cbf-qp", "dob-cbf-qp", "dob-vcbf-qp"])
@pytest.mark.parametrize("cutting", [0, 2])
@pytest.mark.parametrize("obstacles", [3, 200])
def test_tick(benchmark, method, cutting, obstacles):
    settings = {"method": method, "num_cutting": cutting, "num_obstacles": obstacles}
    times = benchmark.pedantic(tick_times, kwargs={**settings, "ticks": 100})
    benchmark.extra_info |= {stage: times[stage] for stage in STAGES}


def test_run(benchmark):
    scenario = load_scenario(
        "blimp-multiple-obstacles", overrides="{period: 0.01, duration: 5.0}"
    )
    simulate(scenario)
    result = benchmark.pedantic(simulate, args=[scenario], rounds=3)
    benchmark.extra_info["real_time_factor"] = result.summary["real_time_factor"]
