from vcbf_drake.cli import progress as module
from vcbf_drake.cli.progress import progress


def test_a_pipe_sees_a_line_now_and_then_with_the_time_left(monkeypatch, capsys):
    seconds = iter([0.0, 5.0, 20.0, 25.0, 40.0, 100.0, 290.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(seconds))
    with progress() as begin:
        advance = begin("40 runs")
        for done in (0.1, 0.2, 0.25, 0.5):
            advance(done)
        begin("replay")(1.0)
    assert capsys.readouterr().err.splitlines() == [
        "40 runs: for 20 s, 20%, about 80 s left",
        "40 runs: for 40 s, 50%, about 40 s left",
        "replay: for 3 min",
    ]


def test_a_short_command_is_silent(capsys):
    with progress() as begin:
        begin("short")(0.5)
    assert capsys.readouterr().err == ""
