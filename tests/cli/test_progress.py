import time

from vcbf_drake.cli import progress as module
from vcbf_drake.cli.progress import progress


def test_a_pipe_sees_a_line_now_and_then_with_the_time_left(monkeypatch, capsys):
    monkeypatch.setattr(module, "_PATIENCE", 0.05)
    with progress() as begin:
        advance = begin("40 runs")
        advance(0.25)
        time.sleep(0.2)
        begin("replay")
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("40 runs: for 0 s, 25%, about ")
    assert lines[-1] == "replay: for 0 s"


def test_a_short_command_is_silent(capsys):
    with progress() as begin:
        begin("short")(0.5)
    assert capsys.readouterr().err == ""
