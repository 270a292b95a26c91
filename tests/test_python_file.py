"""Python files that a user gives: each is a module of its own."""

from pathlib import Path
import pickle

import pytest

from vcbf_drake.errors import ScenarioError
from vcbf_drake.python_file import function_of

TEXT = """
class Thing:
    value = {value}

def make():
    return Thing()
"""


def test_files_of_one_stem_do_not_mix(tmp_path: Path) -> None:
    made = []
    for value in (1, 2):
        path = tmp_path / str(value) / "robot.py"
        path.parent.mkdir()
        path.write_text(TEXT.format(value=value))
        made.append(function_of(path, "make")())
    again = [pickle.loads(pickle.dumps(each)) for each in made]
    assert [each.value for each in again] == [1, 2]
    assert [type(each) for each in again] == [type(each) for each in made]


def test_the_failing_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.py"
    path.write_text("x = 1\n\ny = x / 0\n")
    with pytest.raises(ScenarioError, match=r"robot\.py:3: ZeroDivisionError: "):
        function_of(path, "make")
