"""Two real processes on a real bus, where it carries messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

from pydrake.lcm import DrakeLcm
import pytest

from vcbf_drake.hil import (
    DEFAULT_URL,
    Bus,
    BusError,
    CommandMode,
    SimulatedClock,
    VehicleMode,
    WallClock,
)
from vcbf_drake.hil.bus import check_bus
from vcbf_drake.hil.messages import vcbf_command, vcbf_state

URL = f"udpm://239.255.76.67:{9700 + os.getpid() % 1000}?ttl=0"
COMMAND = [sys.executable, "-W", "error", "-m", "vcbf_drake"]


def bus_works() -> bool:
    try:
        check_bus(URL)
    except BusError:
        return False
    return True


needs_bus = pytest.mark.skipif(
    not bus_works(), reason="no route for multicast: ip route add 224.0.0.0/4 dev lo"
)


@contextlib.contextmanager
def hang_up(action: signal.Handlers) -> Iterator[None]:
    """What a hang-up does to processes that are started, be it under nohup or not."""
    before = signal.signal(signal.SIGHUP, action)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts one side; at the end of a test whatever still runs is killed."""
    processes: list[subprocess.Popen] = []

    def start_side(
        side: str,
        *options: str,
        scenario: str = "car-avoidance",
        at_hang_up=signal.SIG_DFL,
        **popen,
    ) -> subprocess.Popen:
        arguments = [*COMMAND, side, scenario, "--lcm-url", URL, "--json"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | popen
        with hang_up(at_hang_up):
            process = subprocess.Popen([*arguments, *options], **pipes, text=True)
        processes.append(process)
        return processes[-1]

    yield start_side
    for process in processes:
        process.kill()
        process.communicate()


def report(process: subprocess.Popen, status: int = 0) -> dict:
    out, err = process.communicate(timeout=120.0)
    assert process.returncode == status, err
    return json.loads(out)


@needs_bus
@pytest.mark.slow
def test_two_processes_drive_the_car_and_report(start) -> None:
    controller = start("controller", "--duration", "4")
    plant = start("plant", "--duration", "4")
    car, pilot = report(plant), report(controller)
    assert car["outcome"] in ("reached", "timeout")
    assert car["min_barrier"] > 0.0
    assert car["final_distance"] < 4.0
    assert pilot["ticks"] > 50
    for side in (car, pilot):
        assert side["arrived"]["accepted"] > 50
        assert not side["arrived"]["rejected"].get("another type")
        trip = side["round_trip_ms"]
        assert 0.0 < trip["median"] <= trip["p99"]
    assert 0.0 < car["real_time_rate"] < 1.2  # A busy machine is late, never early.
    assert pilot["changes"][-1]["mode"] == "end"


@needs_bus
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stopped_controller_leaves_the_fallback_as_its_last_command(
    number, start
) -> None:
    lcm, commands, states = DrakeLcm(URL), [], []
    for channel, kind, heard in (
        ("VCBF_COMMAND/car-avoidance", vcbf_command, commands),
        ("VCBF_STATE/car-avoidance", vcbf_state, states),
    ):
        lcm.Subscribe(
            channel,
            lambda data, kind=kind, heard=heard: heard.append(kind.decode(data)),
        )

    def listen_until(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < deadline
            lcm.HandleSubscriptions(20)

    controller, plant = start("controller"), start("plant")
    listen_until(lambda: bool(commands and states) and states[-1].time > 0.3)
    controller.send_signal(number)
    listen_until(lambda: commands[-1].mode == CommandMode.END)
    assert not any(commands[-1].input)
    listen_until(lambda: states[-1].mode == VehicleMode.FALLBACK)
    assert report(controller, 128 + number)["changes"][-1]["mode"] == "end"
    plant.send_signal(number)
    assert report(plant, 128 + number)["changes"][-1]["mode"] == "fallback"
    assert commands[-1].mode == CommandMode.END


FAILING = """
from pydrake.systems.framework import LeafSystem
from vcbf_drake import load_scenario


class Driver(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("state", 4)
        self.DeclareVectorOutputPort("reference", 2, self.drive)

    def drive(self, context, output):
        if context.get_time() > 0.3:
            raise RuntimeError("out of fuel")
        output.SetFromVector([0.0, 0.0])


car = load_scenario("car-avoidance")


class Failing(type(car.vehicle)):
    def make_controller(self, target):
        return Driver()


def scenario():
    car.vehicle = Failing()
    return car
"""


@needs_bus
@pytest.mark.slow
def test_a_controller_that_raises_says_where_and_its_vehicle_falls_back(
    start, tmp_path
) -> None:
    path = tmp_path / "failing.py"
    path.write_text(FAILING)
    controller = start("controller", scenario=str(path))
    plant = start("plant", "--duration", "2", "--wait", "60")
    changes = report(plant)["changes"]
    _, err = controller.communicate(timeout=60.0)
    assert controller.returncode == 1
    said = err.splitlines()[-1]
    start_of_line = r"vcbf-drake: UserCodeError: controller at t = ([\d.]+) s, "
    found = re.match(start_of_line, said)
    assert found, said
    assert said[found.end() :].startswith(f"{path}:14: RuntimeError: out of fuel (")
    # It raises at the first tick after 0.3 s; a busy machine may miss some of these.
    assert 0.3 <= float(found[1]) <= changes[-1]["time"]
    assert changes[-1]["mode"] == "fallback"
    assert changes[-1]["time"] < 1.5


@needs_bus
@pytest.mark.slow
@pytest.mark.parametrize("side", ["plant", "controller"])
def test_who_meets_nobody_says_so_and_ends_with_status_5(side, start) -> None:
    alone = start(side, "--wait", "0.5")
    out, err = alone.communicate(timeout=120.0)
    assert alone.returncode == 5, err
    found = json.loads(out)
    assert found["ending"] == "no peer"
    assert found.get("outcome") is None
    peer = "vehicle" if side == "controller" else "controller"
    assert f": no {peer} was heard for 0.5 s\n" in err
    assert ("fallback, no state yet" in err) is (side == "controller")
    assert ("waiting" in err) is (side == "plant")


@needs_bus
@pytest.mark.slow
@pytest.mark.parametrize("side", ["plant", "controller"])
def test_who_waits_under_another_name_is_told_of_those_who_are_there(
    side, start
) -> None:
    alone = start(side, "--wait", "2", "--name", "mine")
    base = "VCBF_STATE" if side == "controller" else "VCBF_STATUS"
    others = [Bus(DrakeLcm(URL), name=name) for name in ("", "theirs", "mine")]
    while alone.poll() is None:
        # In turns: who looks now and then hears one of several that speak at once.
        speaker = others[int(5 * time.monotonic()) % 3]
        speaker.publish(base, b"whatever it says")
        time.sleep(0.01)
    _, err = alone.communicate(timeout=60.0)
    assert alone.returncode == 5
    names = "one without a name, theirs"
    assert f"on this bus under other names: {names} (--name chooses)\n" in err


@needs_bus
@pytest.mark.slow
def test_a_collision_ends_with_status_3_and_every_change_is_told(start) -> None:
    """Nobody commands any more, and the fallback is zero: the car hits the disc."""
    override = ("--override", "{hardware: {fallback: zero}}")
    plant, controller = start("plant", *override), start("controller", *override)
    lcm, states = DrakeLcm(URL), []
    channel = "VCBF_STATE/car-avoidance"
    lcm.Subscribe(channel, lambda data: states.append(vcbf_state.decode(data)))
    deadline = time.monotonic() + 60.0
    while not states or states[-1].time < 2.0:
        assert time.monotonic() < deadline
        lcm.HandleSubscriptions(20)
    controller.kill()
    out, err = plant.communicate(timeout=120.0)
    assert plant.returncode == 3, err
    assert json.loads(out)["ending"] == "collision"
    said = [line for line in err.splitlines() if line.startswith("vehicle: ")]
    # A busy machine may miss periods, and says so beside the changes.
    told = [line.split(": ")[-1] for line in said if "missed" not in line]
    assert told == ["waiting", "following", "fallback"]


@needs_bus
@pytest.mark.slow
def test_an_endless_duration_and_the_log_of_the_crash(start, tmp_path) -> None:
    """A controller that starts again does not replace the log of the one before."""
    log = str(tmp_path / "flight.log")
    for number in (1, 2):
        alone = start("controller", "--duration", "inf", "--wait", "0.3", "--log", log)
        _, err = alone.communicate(timeout=120.0)
        assert alone.returncode == 5, err
        assert "log written to" in err
        assert len(list(tmp_path.iterdir())) == number
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "flight.log",
        "flight.log.01",
    ]


@needs_bus
@pytest.mark.slow
def test_a_controller_flies_on_when_its_terminal_is_gone(start) -> None:
    """What it says reaches nobody, from its first line or from any later one on."""
    controller = start("controller")
    assert controller.stderr.readline().startswith("controller of car-avoidance")
    controller.stderr.close()
    plant = start("plant", "--duration", "0.5", "--wait", "60")
    assert report(plant)["changes"][-1]["mode"] == "following"
    assert json.loads(controller.stdout.read())["ending"] == "vehicle ended"
    assert controller.wait(60.0) == 0


def full_pipe() -> tuple[int, int]:
    """A pipe that takes nothing more, for its reader does not read."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    return reader, writer


@needs_bus
@pytest.mark.slow
def test_a_reader_of_stderr_that_stalls_stops_no_flight(start) -> None:
    reader, writer = full_pipe()
    sides = [
        start(side, "--duration", "1", "--wait", "60", stderr=writer)
        for side in ("controller", "plant")
    ]
    pilot, car = map(report, sides)
    os.close(writer)
    os.close(reader)
    assert pilot["ending"] in ("duration", "vehicle ended")
    assert car["ending"] == "duration"
    modes = {change["mode"] for change in car["changes"]}
    assert modes <= {"waiting", "following", "fallback"}
    assert "following" in modes


@needs_bus
def test_a_hang_up_that_is_ignored_stays_so(start) -> None:
    """As under nohup: the terminal is closed, and the flight goes on."""
    alone = start("plant", "--wait", "1", at_hang_up=signal.SIG_IGN)
    assert alone.stderr.readline().startswith("vehicle of car-avoidance on ")
    alone.send_signal(signal.SIGHUP)
    _, err = alone.communicate(timeout=60.0)
    assert alone.returncode == 5, err


@needs_bus
def test_a_signal_while_everything_is_loaded_is_one_line(start) -> None:
    """Neither a traceback nor an error of half-imported modules."""
    for wait in (0.3, 0.6, 1.0):
        loading = start("controller")
        time.sleep(wait)
        loading.send_signal(signal.SIGTERM)
        _, err = loading.communicate(timeout=60.0)
        assert loading.returncode in (143, -signal.SIGTERM), err
        assert "Traceback" not in err
        assert "Error" not in err


@pytest.mark.parametrize(
    "moment",
    [
        *("typer.main", "vcbf_drake.cli", "typer._adapters", "pydrake.common"),
        # Amid which modules in C++ are made.
        *("pydrake.solvers", "pydrake.geometry"),
    ],
)
@pytest.mark.parametrize(
    ("command", "number"),
    [("plant", signal.SIGINT), ("run", signal.SIGINT), ("controller", signal.SIGHUP)],
)
def test_an_interrupt_at_any_moment_is_one_line(command, number, moment) -> None:
    """As soon as a module has been imported, which Python tells one by one."""
    python = [sys.executable, "-X", "importtime", "-m", "vcbf_drake"]
    with hang_up(signal.SIG_DFL):
        loading = subprocess.Popen(
            [*python, command, "car-avoidance"], stderr=subprocess.PIPE, text=True
        )
    with loading:
        lines = iter(loading.stderr)
        assert any(line.rpartition("|")[2].strip() == moment for line in lines)
        loading.send_signal(number)
        said = [line for line in lines if not line.startswith("import time:")]
    assert loading.returncode == 128 + number
    assert said == ["vcbf-drake: interrupted\n"]


def test_a_missing_server_is_named() -> None:
    words = "tcpq://localhost:9 carries no messages: no LCM server answers there"
    with pytest.raises(BusError, match=words):
        check_bus("tcpq://localhost:9", patience=0.1)


def test_a_name_that_makes_no_channel_is_wrong_usage(start) -> None:
    plant = start("plant", "--name", "a/b")
    _, err = plant.communicate(timeout=60.0)
    assert plant.returncode == 2
    assert err == (
        "vcbf-drake: Invalid value: name: 'a/b'; it must be at most 48 letters,"
        " digits, _ and -\n"
    )


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("memq://", "a bus between processes is tcpq:"),
        ("tcpq://localhost:9", "no LCM server answers there; start one"),
    ],
)
def test_what_is_wrong_with_a_bus_is_one_line_and_status_1(url, words) -> None:
    """The words alone, without the name of a class, and without LCM's own."""
    arguments = ["plant", "car-avoidance", "--lcm-url", url]
    done = subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"vcbf-drake: {url} carries no messages: {words}")


@needs_bus
def test_a_vehicle_without_a_name_says_so(start) -> None:
    plant = start("plant", "--name", "", "--wait", "0.2")
    _, err = plant.communicate(timeout=60.0)
    assert plant.returncode == 5
    first = f"vehicle of car-avoidance on {URL} without a name"
    assert err.splitlines()[0] == first


@pytest.mark.parametrize(
    "url",
    [
        *("udpm://127.0.0.1:7667?ttl=0", "udpm://239.255.76.67", "memq://"),
        *("udpm://239.255.76.67:0", "udpm://239.255.76.67:abc", "nonsense://"),
        *("udpm://999.1.1.1:7667", "udpm://239.255.76.67:99999"),
        # LCM would take these for a port: its first digits, and an octal number.
        *("udpm://239.255.76.67:7667abc?ttl=0", "udpm://239.255.76.67:07667"),
    ],
)
def test_a_url_of_no_bus_between_processes_is_refused(url, capfd) -> None:
    words = re.escape(f"{url} carries no messages: a bus between processes is tcpq:")
    with pytest.raises(BusError, match=words):
        check_bus(url, patience=0.1)
    assert capfd.readouterr() == ("", "")  # Nor has LCM said anything.


@pytest.mark.parametrize("option", ["ttl=far", "ttl=256", "ttl=", "tll=1", "ttl"])
def test_an_option_that_lcm_would_take_for_another_is_refused(option) -> None:
    url = f"udpm://239.255.76.67:7667?{option}"
    with pytest.raises(BusError, match=re.escape(f"{url}: no option {option}; there")):
        check_bus(url)


# The bus itself --------------------------------------------------------------------


@needs_bus
def test_a_bus_waits_for_a_message_and_no_longer() -> None:
    sender, receiver = Bus(DrakeLcm(URL)), Bus(DrakeLcm(URL))
    arrived: list[bytes] = []
    receiver.subscribe("WAITED_FOR", lambda data, now: arrived.append(data))
    start = receiver.clock.utime()
    assert receiver.wait(start + 5_500) == 0
    assert receiver.clock.utime() >= start + 5_500
    sender.publish("WAITED_FOR", b"abc")
    assert receiver.wait(receiver.clock.utime() + 10_000_000) == 1
    assert arrived == [b"abc"]


def test_without_a_route_the_check_fails_and_says_how_to_mend_it() -> None:
    """In a network namespace of its own there is no route for multicast."""
    unshare = shutil.which("unshare")
    isolated = [unshare, "-rn"] if unshare else []
    if not unshare or subprocess.run([*isolated, "true"], check=False).returncode:
        pytest.skip("this computer gives no network namespace")
    for side in ("plant", "controller"):
        done = subprocess.run(
            [*isolated, *COMMAND, side, "car-avoidance"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 1
        last = done.stderr.strip().splitlines()[-1]
        assert last.startswith(f"vcbf-drake: {DEFAULT_URL} carries no messages: ")
        assert "sudo ip route add 224.0.0.0/4 dev lo" in last


def test_a_default_stays_on_this_computer() -> None:
    assert DEFAULT_URL.endswith("ttl=0")


def test_clocks() -> None:
    wall = WallClock()
    assert abs(wall.utime() - 1e6 * time.time()) < 1e6
    assert wall.utime() <= wall.utime()
    simulated = SimulatedClock(5)
    simulated.now += 2
    assert simulated.utime() == 7
