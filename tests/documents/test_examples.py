from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import re
import runpy
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """What an example without processes prints, run in this one, as a short check."""

    def run(name: str) -> str:
        path = str(ROOT / "examples" / f"{name}.py")
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(str(ROOT / "examples"))
        monkeypatch.setattr(sys, "argv", [path, "--short"])
        runpy.run_path(path, run_name="__main__")
        return capsys.readouterr().out

    return run


def run(name: str, directory: Path) -> str:
    """What an example prints when it runs in another directory, as a short check."""
    done = subprocess.run(
        [sys.executable, "-W", "error", str(ROOT / "examples" / name), "--short"],
        cwd=directory,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLCONFIGDIR": str(directory)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def number(text: str, label: str) -> float:
    """The number that follows a label."""
    found = re.search(rf"{label}:? (-?[\d.]+)", text)
    assert found, f"no '{label}' in: {text}"
    return float(found[1])


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("arm_beside_wall", 0.2),
        ("own_plant", 1.0),
        ("own_barrier", 4.41),
        ("two_blimps", 0.2),
        ("teleoperator", 0.1),
        ("read_a_log", 2.0),
    ],
)
def test_example_stays_safe_and_leaves_a_picture(name, most, tmp_path, run_here):
    text = run_here(name)
    assert 0.0 < number(text, "min h") < most
    assert number(text, "infeasible ticks") == 0
    picture = tmp_path / "out" / "examples" / f"{name}.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_widened_volume_barrier_always_has_an_input(tmp_path, run_here):
    text = run_here("adaptive_cruise_control")
    assert number(text, "no volume barrier: no input left at") == 6.16
    assert number(text, "the paper's: no input left at") == 6.52
    assert "widened: always an input" in text
    picture = tmp_path / "out" / "examples" / "adaptive_cruise_control.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_smallest_loop_keeps_its_distance(run_here):
    text = run_here("smallest_loop")
    assert number(text, "least distance to the sphere") > 0.0


def test_search_reports_on_every_course(run_here):
    assert run_here("search_layouts").startswith("2 courses")


def test_own_controller_drives_the_car(tmp_path):
    text = run("own_controller_process.py", tmp_path)
    if "carries no messages" in text:
        pytest.skip("no route for multicast")
    assert number(text, "answered") > 20
    assert number(text, "min h") > 0.0


def test_slow_link_is_closer_to_the_ideal_path_with_prediction(run_here):
    text = run_here("slow_link")
    away = [int(match) for match in re.findall(r"(\d+) mm from the path", text)]
    volume = [float(match) for match in re.findall(r"min V_v (-?[\d.]+)", text)]
    assert len(away) == 3
    assert away[2] < away[1]
    assert volume[2] > volume[1]


@pytest.mark.slow
def test_a_boat_in_another_language_is_controlled(tmp_path):
    text = run("boat_controller.py", tmp_path)
    if "skipped: the boat needs" in text or "no route for multicast" in text:
        pytest.skip(text.strip())
    assert number(text, "min h") > 0.0
    assert number(text, "infeasible ticks") == 0
    assert "refuted: nothing" in text
    assert "0 rejected" in text


def test_hardware_faults_reports_from_both_sides(tmp_path):
    text = run("hardware_faults.py", tmp_path)
    if "carries no messages" in text:
        pytest.skip("no route for multicast")
    assert number(text, "min h") > 0.0
    assert text.count("round trip") == 2


def test_tuning_study_counts_every_flight(tmp_path, run_here):
    lines = run_here("tuning_study").splitlines()
    kept = {line[:26].strip(): line[26:].split()[:3] for line in lines[1:]}
    assert len(kept) == 4
    # Within the 5 s of the check, the paper's form loses two of its three courses.
    assert kept["the paper's form"] == ["3", "1", "0"]
    assert kept["8 x as wide, gain 0.1"] == ["3", "3", "0"]
    picture = tmp_path / "out" / "examples" / "tuning_study.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_gallery_lists_every_example_and_its_pictures_exist():
    gallery = (ROOT / "examples" / "README.md").read_text()
    programs = {path.name for path in (ROOT / "examples").glob("*.py")}
    assert set(re.findall(r"\]\((\w+\.py)\)", gallery)) == programs
    for image in re.findall(r"!\[[^]]+\]\(([^)]+)\)", gallery):
        assert (ROOT / "examples" / image).is_file()
