import io
import re
import sys
from threading import Event

from vcbf_drake.cli import progress as module
from vcbf_drake.cli.progress import progress


class Told(io.StringIO):
    """A pipe whose reader can wait for a line about something."""

    def __init__(self):
        super().__init__()
        self.line = Event()

    def flush(self):
        self.line.set()

    def wait_for(self, words):
        while words not in self.getvalue():
            self.line.clear()
            assert self.line.wait(60.0)


def test_a_pipe_sees_a_line_now_and_then_with_the_time_left(monkeypatch):
    told = Told()
    monkeypatch.setattr(sys, "stderr", told)
    monkeypatch.setattr(module, "_PATIENCE", 0.05)
    with progress() as begin:
        advance = begin("40 runs")
        advance(0.25)
        told.wait_for(" left\n")
        begin("replay")
        told.wait_for("replay")
    task, left = r"(40 runs|replay): for \d+ s", r", 25%, about \d+ s left"
    lines = told.getvalue().splitlines()
    assert all(re.fullmatch(f"{task}({left})?", line) for line in lines)
    assert any(re.fullmatch(f"40 runs.*{left}", line) for line in lines)
    assert re.fullmatch(r"replay: for \d+ s", lines[-1])


def test_a_short_command_is_silent(capsys):
    with progress() as begin:
        begin("short")(0.5)
    assert capsys.readouterr().err == ""
