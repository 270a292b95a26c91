"""Whole runs of shipped scenarios, each once in a process of tests."""

from __future__ import annotations

from functools import cache

from vcbf_drake.simulation import Result, load_scenario, simulate


@cache
def shipped_run(name: str, method: str) -> Result:
    """The run of a shipped scenario under a method: to be looked at, only."""
    result = simulate(load_scenario(name, {"method": method}))
    for values in result.log.values():
        values.flags.writeable = False
    return result
