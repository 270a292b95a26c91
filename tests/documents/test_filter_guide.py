"""The page on the filter: its program runs, its links resolve, no status is missing."""

from __future__ import annotations

from pathlib import Path
import re
from typing import Any

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from vcbf_drake import (
    AddSafetyFilter,
    FilterSettings,
    FilterStatus,
    InputSet,
    StateLimit,
)

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "guide" / "filter.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


def test_the_check_of_a_loop_runs_and_finds_nothing_wrong(capsys) -> None:
    exec(compile(BLOCKS[0], "filter.md", "exec"), {})
    printed = capsys.readouterr().out
    # phi_1 = h' + 3 h at x = 0, v = 0.5.
    start = "start inside: end of the rail (high) holds (phi_0 = 1, phi_1 = 2.5)"
    assert start in printed
    assert "does not hold" not in printed


def test_a_cart_that_can_back_away_never_leaves_its_rail() -> None:
    """Its reference only pushes, its brakes are weaker than its barrier believes."""
    page: dict[str, Any] = {}
    for i, block in enumerate(BLOCKS):
        exec(compile(block, f"filter.md, {i}", "exec"), page)
    builder = DiagramBuilder()
    matrices = [[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 1]], [[0], [0]]
    plant = builder.AddSystem(page["Cart"](*matrices))
    push = builder.AddSystem(ConstantVectorSource([2.0]))
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=push.get_output_port(),
        barriers=StateLimit(0, upper=1.0).barriers([20.0, 100.0]),
        input_set=InputSet.box([-0.5], [2.0]),
        settings=FilterSettings(method="cbf-qp", infeasible="backup", period=0.05),
    )
    simulator = Simulator(builder.Build())
    root = simulator.get_context()
    context = safety.filter.GetMyContextFromRoot(root)
    shares, places = [], []
    for k in range(200):
        simulator.AdvanceTo(0.05 * k)
        share, certified = safety.filter.GetOutputPort("backup").Eval(context)
        assert certified == 1.0
        shares.append(share)
        places.append(plant.get_output_port().Eval(plant.GetMyContextFromRoot(root))[0])
    assert max(shares) > 0.0
    assert 0.5 < max(places) <= 1.0


def test_every_status_is_explained() -> None:
    for status in FilterStatus:
        assert f"| {int(status)} `{status.name}` |" in PAGE


def test_links_resolve() -> None:
    theory = (DOCS / "theory.md").read_text(encoding="utf-8")
    for label in re.findall(r"\]\(\.\./theory\.md#([^)]+)\)", PAGE):
        assert f'<a id="{label}"></a>' in theory
    for link in re.findall(r"\]\(([^)#:]+)\)", PAGE):
        assert (DOCS / "guide" / link).exists(), link
