"""The rate sweep and its page."""

import json

import pytest
from typer.testing import CliRunner

from vcbf_drake.cli import app
from vcbf_drake.studies import rate_sweep
from vcbf_drake.studies.rate_sweep import MOVING_WALL, sweep_markdown, sweep_rates
from vcbf_drake.viz.terminal import rounded_down


@pytest.fixture
def wall_alone(monkeypatch):
    monkeypatch.setattr(rate_sweep, "SCENARIOS", ())
    monkeypatch.setattr(rate_sweep, "RATES", (20.0, 50.0, 100.0))


def test_what_sampling_costs_shrinks_like_the_period(wall_alone):
    done = []
    records = sweep_rates((20.0, 40.0), done.append)
    assert done[-1] == 1.0
    kinds = [(each["rate"], each["between_ticks"]) for each in records]
    assert kinds == [
        (20.0, "none"),
        (20.0, "certified"),
        (40.0, "none"),
        (40.0, "certified"),
    ]
    slow, slow_certified, fast, fast_certified = records
    assert slow["min_barrier"] < fast["min_barrier"] < 0.0
    assert slow["min_barrier"] / fast["min_barrier"] == pytest.approx(2.0, rel=0.2)
    for each in (slow_certified, fast_certified):
        assert each["certified_min_barrier"] >= 0.0
        assert each["infeasible_ticks"] == 0
    # The price: the car keeps more distance.
    assert slow_certified["median_barrier"] > slow["median_barrier"]


def test_the_page_has_a_row_a_run(wall_alone, tmp_path):
    result = CliRunner().invoke(app, ["rate-sweep", "--quick", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    records = json.loads((tmp_path / "rate_sweep.json").read_text())
    page = (tmp_path / "rate_sweep.md").read_text()
    assert page == sweep_markdown(records, "vcbf-drake rate-sweep --quick")
    assert {each["rate"] for each in records} == {20.0, 50.0}
    assert "Made by `vcbf-drake rate-sweep --quick`" in page
    rows = [line for line in page.splitlines() if line.startswith("| 20 | certified |")]
    assert len(rows) == 1
    assert f"## {MOVING_WALL}" in page
    assert rounded_down(records[1]["certified_min_barrier"]) in rows[0]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.032289, "0.0322"), (-0.012441, "-0.0125"), (2.0, "2"), (0.0, "0")],
)
def test_a_bound_stays_one_when_it_is_rounded(value, text):
    assert rounded_down(value) == text
