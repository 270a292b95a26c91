"""What routes, ours and others', cost on the same instances, and how right they are.

`problem` is what everybody solves, `reference` has the answers, `ours` and `peers` are
who solves it, `tasks` lists them, `measure` times them.
"""

from vcbf_drake.studies.bench.measure import run_bench

__all__ = ["run_bench"]
