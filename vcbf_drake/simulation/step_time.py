"""The CPU time of a filter's ticks, measured after a run."""

from __future__ import annotations

import time

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.disturbances import DisturbanceEstimate
from vcbf_drake.safety import SafetyFilter

# Ticks whose CPU time is measured.
_SAMPLES = 200


def step_cpu_time(
    safety_filter: SafetyFilter, log: dict[str, Array]
) -> dict[str, float]:
    """Returns median and 99th percentile of one filter tick's CPU time [ms].

    The filter is pure, so its ticks are simply evaluated again, from the log, with
    nothing else around them: rows, ellipsoid, gradient and QP.

    Args:
        safety_filter: The filter that ran.
        log: The log of the run.
    """
    context = safety_filter.CreateDefaultContext()
    ticks = np.unique(
        np.linspace(0, len(log["time"]) - 1, _SAMPLES).round().astype(int)
    )
    held = np.zeros(safety_filter.model.num_inputs)
    spent = []
    for tick in ticks:
        values = {
            "state": log["state"][tick],
            "reference": log["reference"][tick],
            "held_input": held,
        }
        if "obstacles" in log:
            values["obstacles"] = log["obstacles"][tick]
        if safety_filter.HasInputPort("estimate"):
            values["estimate"] = DisturbanceEstimate(
                log["disturbance_estimate"][tick],
                log["estimate_rate"][tick],
                log["error_bound"][tick],
                log["error_bound_rate"][tick],
                log["refused_intervals"][tick],
                log["quadrature_error"][tick],
            ).pack()
        context.SetTime(float(log["time"][tick]))
        for name, value in values.items():
            safety_filter.GetInputPort(name).FixValue(context, value)
        started = time.thread_time()
        safety_filter.decision(context)
        spent.append(1e3 * (time.thread_time() - started))
    return {
        "median": float(np.median(spent)),
        "p99": float(np.percentile(spent, 99.0)),
    }
