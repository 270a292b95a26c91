"""One channel's inbox: what is taken, what is not, and that all of it is counted."""

from __future__ import annotations

from hypothesis import example, given, settings, strategies as st
from pydrake.lcm import DrakeLcm
import pytest

from tests.helpers.memory_bus import MemoryLcm
from vcbf_drake.hil import (
    Bus,
    BusError,
    CommandMode,
    Inbox,
    LinkFaults,
    Reason,
    SimulatedClock,
    command_format,
    read_key,
    state_format,
    vehicle_name,
)
from vcbf_drake.hil.messages import vcbf_command, vcbf_state

FORM = command_format(2)
STATES = state_format(1, 1)
MS = 1000  # In microseconds.
SECOND = 1000 * MS


class Bench:
    """An inbox, and whoever sends to it."""

    def __init__(self, faults: LinkFaults | None = None, **options) -> None:
        self.clock = SimulatedClock()
        lcm = DrakeLcm("memq://") if faults else MemoryLcm()
        self.bus = Bus(lcm, self.clock, faults)
        self.sender = Bus(lcm, self.clock)
        self.accepted: list[int] = []
        self.inbox = Inbox(
            self.bus,
            FORM,
            0.1,
            lambda message, now: self.accepted.append(message),
            **options,
        )
        self.clock.now += 1000 * MS

    def message(self, sequence: int, age: int = 0, session: int | None = None):
        message = vcbf_command()
        message.version, message.sequence = 2, sequence
        message.utime = self.clock.now - age
        message.session = self.sender.session if session is None else session
        message.num_inputs, message.input = 2, [0.5, -0.5]
        return message

    def receive(
        self, sequence: int, age: int = 0, session: int | None = None, **values
    ):
        message = self.message(sequence, age, session)
        for name, value in values.items():
            setattr(message, name, value)
        self.inbox.receive(message.encode(), self.clock.now)

    @property
    def sequences(self) -> list[int]:
        return [message.sequence for message in self.accepted]


def test_messages_in_order_are_all_taken() -> None:
    bench = Bench()
    for sequence in range(5):
        bench.receive(sequence)
    assert bench.sequences == [0, 1, 2, 3, 4]
    assert bench.inbox.newest.sequence == 4
    assert (bench.inbox.lost, bench.inbox.late, bench.inbox.rejected) == (0, 0, 0)


def test_what_goes_back_is_not_taken_and_a_late_one_is_not_lost() -> None:
    bench = Bench()
    for sequence in (0, 3, 1, 1, 3, 5, 0):
        bench.receive(sequence)
    assert bench.sequences == [0, 3, 5]
    assert bench.inbox.rejections == {Reason.OVERTAKEN: 1, Reason.REPEATED: 3}
    assert (bench.inbox.lost, bench.inbox.late, bench.inbox.rejected) == (2, 1, 3)


def test_a_replay_from_long_ago_is_repeated() -> None:
    bench = Bench()
    for sequence in range(200):
        bench.receive(sequence)
    bench.receive(3)
    assert bench.inbox.rejections == {Reason.REPEATED: 1}


def test_a_message_too_old_is_late_and_not_lost() -> None:
    bench = Bench()
    bench.receive(0)
    bench.receive(1, age=101 * MS)
    bench.receive(2, age=99 * MS)
    assert bench.sequences == [0, 2]
    assert bench.inbox.rejections == {Reason.OLD: 1}
    assert (bench.inbox.lost, bench.inbox.late) == (0, 1)
    assert bench.inbox.complaint(bench.clock.now) == (
        "1 rejected, the last: too old (0.10 s)"
    )


def test_a_leap_of_the_sequence_is_refused_and_costs_nothing() -> None:
    """No sender is as fast; the true one's numbers would be repeated for ever."""
    bench = Bench()
    bench.receive(0)
    bench.receive(10**12)
    assert bench.inbox.rejections == {Reason.STAMPS: 1}
    bench.receive(1)
    assert bench.sequences == [0, 1]
    assert bench.inbox.lost == 0
    bench.clock.now += 10 * SECOND
    bench.receive(5001)  # 500 Hz, ten seconds without a message.
    assert bench.sequences == [0, 1, 5001]
    assert bench.inbox.lost == 4999


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sequence", 10**15),
        ("session", SimulatedClock().now + 2 * SECOND),
        ("utime_measured", SimulatedClock().now - SECOND),
        ("time", 60.0),
    ],
)
def test_a_sender_that_cannot_be_true_by_its_own_clock_is_not_met(name, value) -> None:
    clock = SimulatedClock()
    inbox = Inbox(Bus(MemoryLcm(), clock), STATES, 0.1)
    message = state(clock, 0)
    clock.now += SECOND
    message.utime = message.utime_measured = clock.now
    setattr(message, name, value)
    inbox.receive(message.encode(), clock.now)
    assert inbox.rejections == {Reason.TIME if name == "time" else Reason.STAMPS: 1}
    assert ("(on by 60 s in a session of 1 s" in inbox.last_rejection) == (
        name == "time"
    )


# Who is followed -------------------------------------------------------------------


@pytest.mark.parametrize("later", [True, False])
def test_another_sender_is_followed_only_after_silence(later: bool) -> None:
    bench, other = Bench(), 1 if not later else SimulatedClock().now + SECOND
    bench.receive(70)
    for sequence in range(5):
        bench.receive(sequence, session=other)
        bench.receive(71 + sequence)
        bench.clock.now += 20 * MS
    assert bench.sequences == [70, 71, 72, 73, 74, 75]
    assert bench.inbox.rejections == {Reason.SESSION: 5}
    bench.clock.now += 100 * MS
    bench.receive(5, session=other)
    bench.receive(76)
    assert bench.sequences[-1] == 5
    assert bench.inbox.rejections == {Reason.SESSION: 6}
    # And the first comes back when that one falls silent in its turn.
    bench.clock.now += 101 * MS
    bench.receive(80)
    assert bench.sequences[-1] == 80
    assert bench.inbox.lost == 0


def test_a_farewell_makes_room_at_once() -> None:
    bench = Bench()
    bench.receive(0)
    bench.receive(1, mode=int(CommandMode.END))
    bench.receive(0, session=1)
    assert [message.session for message in bench.accepted][-1] == 1


def test_a_stray_farewell_of_another_session_changes_nothing() -> None:
    bench = Bench()
    bench.receive(0)
    bench.receive(0, session=bench.clock.now, mode=int(CommandMode.END))
    bench.receive(1)
    assert bench.sequences == [0, 1]


def test_an_open_take_over_is_followed_at_once_by_a_later_session_only() -> None:
    bench = Bench()
    bench.receive(0)
    bench.receive(0, session=1, takes_over=True)
    assert bench.sequences == [0]
    bench.receive(7, session=bench.clock.now, takes_over=True)
    bench.receive(1, takes_over=True)
    assert bench.sequences == [0, 7]


def test_old_sessions_are_remembered_so_that_their_past_is_no_news() -> None:
    bench = Bench()
    for sequence in range(5):
        bench.receive(sequence)
    bench.clock.now += 101 * MS
    bench.receive(0, session=1)
    bench.clock.now += 101 * MS
    bench.receive(3)
    assert bench.inbox.rejections == {Reason.REPEATED: 1}


# Clocks ----------------------------------------------------------------------------


def state(clock: SimulatedClock, sequence: int, offset: int = 0):
    """What a vehicle with a clock of its own says."""
    message = vcbf_state()
    message.version, message.sequence = 2, sequence
    message.session = SimulatedClock().now + offset
    message.utime = message.utime_measured = clock.now + offset
    message.time = 1e-6 * (clock.now - SimulatedClock().now)
    message.num_states = message.num_inputs = 1
    message.state = message.input_integral = [0.0]
    return message


class Pair:
    """A vehicle with its own clock at the other end of a link that takes its time."""

    def __init__(self, offset: int, max_age: float = 0.1) -> None:
        self.clock, self.offset = SimulatedClock(), offset
        self.now = self.clock.now
        bus = Bus(MemoryLcm(), self.clock)
        self.accepted: list[int] = []
        self.inbox = Inbox(
            bus,
            STATES,
            max_age,
            lambda message, now: self.accepted.append(now),
            echo=lambda message: (
                (message.command_utime, message.command_age)
                if message.command_session > 0
                else None
            ),
        )
        self._session, self._sequence = self.now + offset, 0
        self._command: tuple[int, int] | None = None
        self.late: list[tuple[int, vcbf_state]] = []

    def tick(self, there: int = 2 * MS, back: int = 2 * MS, more: int = 0) -> None:
        """The vehicle speaks; we answer; it has heard us, or 10 ms have passed.

        Args:
            there: How long its message takes [us].
            back: How long ours takes [us].
            more: How much too long it says that it has had ours [us].
        """
        message = state(self.clock, self._sequence)
        message.session = self._session
        message.utime = message.utime_measured = self.clock.now + self.offset
        message.command_session = -1
        if self._command is not None:
            sent, came = self._command
            message.command_session, message.command_utime = 1, sent
            message.command_age = message.utime - came + more
        self._sequence += 1
        start = self.clock.now
        self.clock.now = start + there
        self.inbox.receive(message.encode(), self.clock.now)
        self._command = self.clock.now, self.clock.now + back + self.offset
        self.clock.now = start + max(10 * MS, there + back)

    def step_clock(self, step: int) -> None:
        self.offset += step


@pytest.mark.parametrize("offset", [0, -59 * SECOND, 59 * SECOND, 3 * MS])
def test_a_constant_offset_is_measured_and_does_no_harm(offset: int) -> None:
    pair = Pair(offset)
    for _ in range(100):
        pair.tick()
    assert len(pair.accepted) == 100
    assert not pair.inbox.rejections
    clock = pair.inbox.peer_clock
    assert abs(clock.offset - offset) <= 1
    assert clock.uncertainty <= 3 * MS


@pytest.mark.parametrize(
    ("offset", "reason", "words"),
    [
        (61 * SECOND, Reason.FUTURE, "61.0 s ahead; max_clock_offset is 60 s"),
        (-61 * SECOND, Reason.PAST, "61.0 s behind; max_clock_offset is 60 s"),
    ],
)
def test_a_clock_too_far_off_is_refused_with_its_offset(offset, reason, words) -> None:
    pair = Pair(offset)
    pair.tick(there=0)
    assert pair.inbox.rejections == {reason: 1}
    assert words in pair.inbox.last_rejection


@settings(max_examples=100, deadline=None, derandomize=True)
@example(0, [(0, 0)] * 28 + [(15_002, 0), (2, 0)])
@given(
    offset=st.integers(-5 * SECOND, 5 * SECOND),
    delays=st.lists(
        st.tuples(st.integers(0, 40 * MS), st.integers(0, 40 * MS)),
        min_size=30,
        max_size=30,
    ),
)
def test_the_offset_is_within_its_uncertainty(offset, delays) -> None:
    """Whatever each message's delay; the bound is Mills' with nothing in common."""
    pair = Pair(offset)
    for there, back in delays:
        pair.tick(there, back)
    clock = pair.inbox.peer_clock
    fastest = min(t for t, _ in delays), min(b for _, b in delays[:-1])
    assert abs(clock.offset - offset) <= clock.uncertainty + 1
    assert clock.uncertainty <= sum(fastest) / 2 + 200  # And a little drift.


@pytest.mark.parametrize("step", [SECOND, -SECOND, 30 * SECOND, -10 * SECOND])
def test_a_step_of_the_vehicle_s_clock_is_survived_and_reported(step: int) -> None:
    pair = Pair(0)
    for _ in range(50):
        pair.tick()
    pair.step_clock(step)
    for _ in range(50):
        pair.tick()
    clock = pair.inbox.peer_clock
    assert clock.steps == 1
    assert clock.last_step == pytest.approx(step, abs=5 * MS)
    assert len(pair.accepted) >= 95
    assert pair.accepted[-1] == pair.clock.now - 8 * MS


@pytest.mark.parametrize("more", [SECOND, 10**17, -(10**17)])
def test_an_age_that_no_command_can_have_costs_no_state(more: int) -> None:
    """As of a vehicle that fills in nanoseconds, or what happens to be there."""
    pair = Pair(3 * SECOND)
    for _ in range(50):
        pair.tick(more=more)
    clock = pair.inbox.peer_clock
    assert not pair.inbox.rejections
    assert clock.steps == 0
    assert abs(clock.offset - 3 * SECOND) <= 3 * MS


@pytest.mark.parametrize("pace", [1e-3, -0.01, 0.01, 0.083])
def test_a_clock_of_another_pace_is_followed(pace: float) -> None:
    """A board without a crystal is 1 % off; chrony slews a clock by 8.3 % at most."""
    pair = Pair(SECOND)
    for _ in range(6000):
        pair.tick()
        pair.step_clock(round(pace * 10 * MS))
    clock = pair.inbox.peer_clock
    assert not pair.inbox.rejections
    assert abs(clock.offset - pair.offset) <= 3 * MS
    assert clock.steps == 0


def test_a_clock_that_stands_still_is_refused_with_a_reason() -> None:
    """What comes with it may be as old as it likes."""
    pair = Pair(0)
    for _ in range(50):
        pair.tick()
    for _ in range(450):
        pair.tick()
        pair.step_clock(-10 * MS)
    assert pair.inbox.peer_clock.steps == 1
    assert len(pair.accepted) < 80
    assert pair.inbox.rejections[Reason.CLOCK] > 400
    complaint = pair.inbox.complaint(pair.clock.now)
    assert "contradicts its sender's clock (by 4." in complaint


def test_without_a_round_trip_a_clock_set_back_is_believed_after_half_a_second() -> (
    None
):
    bench = Bench()
    for sequence in range(10):
        bench.receive(sequence)
        bench.clock.now += 10 * MS
    for sequence in range(10, 110):
        bench.receive(sequence, age=SECOND)
        bench.clock.now += 10 * MS
    assert bench.inbox.rejections == {Reason.OLD: pytest.approx(51, abs=2)}
    assert bench.inbox.newest.sequence == 109


def test_a_burst_of_what_is_old_is_not_a_clock_set_back() -> None:
    """What piled up while this process was stopped for two seconds."""
    bench = Bench()
    for sequence in range(10):
        bench.receive(sequence)
        bench.clock.now += 10 * MS
    bench.clock.now += 2 * SECOND
    for sequence in range(10, 190):
        bench.receive(sequence, age=2 * SECOND - 10 * MS * (sequence - 10))
    assert bench.inbox.rejections == {Reason.OLD: 180}


def test_one_stray_message_moves_no_clock() -> None:
    pair = Pair(0)
    for _ in range(20):
        pair.tick()
    forged = state(pair.clock, 20, 30 * SECOND)
    forged.session = SimulatedClock().now
    pair.inbox.receive(forged.encode(), pair.clock.now)
    assert pair.inbox.rejections == {Reason.CLOCK: 1}
    pair._sequence = 21
    for _ in range(20):
        pair.tick()
    assert len(pair.accepted) == 40
    assert abs(pair.inbox.peer_clock.offset) <= 1


def test_a_slow_link_is_too_old_once_the_round_trip_is_known() -> None:
    pair = Pair(7 * SECOND, max_age=0.1)
    pair.tick(there=300 * MS, back=300 * MS)
    assert len(pair.accepted) == 1  # There is no saying yet.
    for _ in range(100):
        pair.tick(there=300 * MS, back=300 * MS)
    assert len(pair.accepted) <= 2
    assert pair.inbox.rejections[Reason.OLD] >= 99


def test_a_motion_s_time_does_not_leap_or_go_back() -> None:
    clock = SimulatedClock()
    inbox = Inbox(Bus(MemoryLcm(), clock), STATES, 0.1)
    for sequence, time in enumerate([0.0, 0.02, 5.0, 0.01, 0.04]):
        message = state(clock, sequence)
        message.time = time
        inbox.receive(message.encode(), clock.now)
        clock.now += 20 * MS
    assert inbox.rejections == {Reason.TIME: 2}
    assert inbox.newest.time == 0.04


@pytest.mark.parametrize("rate", [1000.0, 1.1])
def test_a_time_that_runs_ahead_stays_refused_and_a_late_one_is_welcome(rate) -> None:
    """The silence that a refusal makes is no reason to believe it."""
    clock = SimulatedClock()
    inbox = Inbox(Bus(MemoryLcm(), clock), STATES, 0.1)
    sent = 0

    def send(time: float) -> bool:
        nonlocal sent
        message = state(clock, sent)
        message.time, sent = time, sent + 1
        inbox.receive(message.encode(), clock.now)
        clock.now += 20 * MS
        return bool(inbox.newest.time == time)

    accepted = [send(rate * 0.02 * tick) for tick in range(500)]
    assert accepted == sorted(accepted, reverse=True)
    assert not accepted[-1]
    assert inbox.last_rejection.startswith("its motion's time leaps (on by")
    assert send(inbox.newest.time + 0.02)  # It has come to its senses.
    clock.now += 5 * SECOND  # A silence of its own, in which its time went on.
    assert send(inbox.newest.time + 5.3)


# The bus ---------------------------------------------------------------------------


def test_what_a_bus_sends_is_numbered_and_stamped() -> None:
    bench = Bench()
    for _ in range(3):
        message = vcbf_command()
        message.num_inputs, message.input = 2, [0.0, 0.0]
        bench.sender.send(FORM.channel, message)
        bench.clock.now += MS
    assert bench.bus.poll() == 3
    assert bench.sequences == [0, 1, 2]
    assert bench.sender.sent[FORM.channel] == 3
    assert bench.inbox.newest.session == bench.sender.session
    assert bench.inbox.newest.utime == bench.clock.now - MS
    bench.clock.now += 200 * MS
    bench.sender.begin_session()
    bench.sender.send(FORM.channel, message)
    bench.bus.poll()
    assert bench.sequences == [0, 1, 2, 0]
    assert bench.inbox.newest.session == bench.clock.now


def test_taps_see_what_is_sent_and_what_arrives() -> None:
    bench, sent, arrived = Bench(LinkFaults(drop=1.0)), [], []
    bench.sender.taps.append(lambda *event: sent.append(event))
    bench.bus.taps.append(lambda *event: arrived.append(event))
    bench.sender.publish(FORM.channel, b"abc")
    bench.bus.poll()
    assert sent == [(bench.clock.now, FORM.channel, b"abc")]
    assert arrived == []


def test_vehicles_with_names_share_a_bus() -> None:
    lcm, clock = DrakeLcm("memq://"), SimulatedClock()
    buses = {name: Bus(lcm, clock, name=name) for name in ("a", "b")}
    heard: list[tuple[str, bytes]] = []
    for name, bus in buses.items():
        bus.subscribe("C", lambda data, now, name=name: heard.append((name, data)))
    taps: list[str] = []
    buses["a"].taps.append(lambda utime, channel, data: taps.append(channel))
    buses["a"].publish("C", b"1")
    for bus in buses.values():
        bus.poll()
    assert heard == [("a", b"1")]
    assert taps == ["C/a", "C/a"]


def test_names_that_make_no_channel_are_refused() -> None:
    for name in ("a b", "a/b", "x" * 49, "ä", "a.*"):
        with pytest.raises(ValueError, match=r"^name: .*; it must be at most 48"):
            Bus(MemoryLcm(), SimulatedClock(), name=name)
        Bus(MemoryLcm(), SimulatedClock(), name=vehicle_name(name))


# Signatures ------------------------------------------------------------------------


def signed(lcm, clock, key: bytes, name: str = "") -> Bus:
    return Bus(lcm, clock, name=name, key=key)


def test_only_what_is_signed_with_the_key_for_this_channel_arrives() -> None:
    clock, lcm, key = SimulatedClock(), DrakeLcm("memq://"), b"k" * 32
    bus = signed(lcm, clock, key)
    inbox, wire = Inbox(bus, FORM, 0.1), []
    lcm.Subscribe(FORM.channel, wire.append)
    clock.now += SECOND
    for sender in (
        signed(lcm, clock, key),
        Bus(lcm, clock),
        signed(lcm, clock, b"x" * 32),
    ):
        message = vcbf_command()
        message.num_inputs, message.input = 2, [0.0, 0.0]
        clock.now += 1
        sender.send(FORM.channel, message)
        bus.poll()
    assert inbox.accepted == 1
    assert inbox.rejections == {Reason.SIGNATURE: 2}
    assert len(wire[0]) == len(wire[1]) + 32
    # Every bit counts, and what was recorded is repeated.
    for place in range(0, len(wire[0]), 7):
        changed = bytearray(wire[0])
        changed[place] ^= 1
        lcm.Publish(FORM.channel, bytes(changed))
        bus.poll()
    lcm.Publish(FORM.channel, b"")
    bus.poll()
    assert inbox.accepted == 1
    assert set(inbox.rejections) == {Reason.SIGNATURE}
    lcm.Publish(FORM.channel, wire[0])
    bus.poll()
    assert inbox.rejections[Reason.REPEATED] == 1


def test_a_signature_is_for_one_vehicle() -> None:
    clock, lcm, key = SimulatedClock(), DrakeLcm("memq://"), b"k" * 32
    wire: list[bytes] = []
    lcm.Subscribe("C/a", wire.append)
    signed(lcm, clock, key, "a").publish("C", b"data")
    lcm.HandleSubscriptions(0)
    other, heard, tapped = signed(lcm, clock, key, "b"), [], []
    other.subscribe("C", lambda data, now: heard.append(data))
    other.taps.append(lambda *event: tapped.append(event))
    lcm.Publish("C/b", wire[0])
    other.poll()
    assert (heard, tapped) == ([None], [])


def test_a_signature_is_rfc_2104_s_over_channel_and_message() -> None:
    """By the hash alone: what a vehicle in another language has to compute."""
    import hashlib

    key, channel, data = b"0123456789abcdef", b"C/a", b"data"
    padded = key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(b ^ 0x36 for b in padded) + channel + b"\0" + data)
    outer = hashlib.sha256(bytes(b ^ 0x5C for b in padded) + inner.digest())
    clock, lcm, wire = SimulatedClock(), DrakeLcm("memq://"), []
    lcm.Subscribe("C/a", wire.append)
    signed(lcm, clock, key, "a").publish("C", data)
    lcm.HandleSubscriptions(0)
    assert wire == [data + outer.digest()]


def test_a_key_is_a_file_of_at_least_sixteen_bytes(tmp_path) -> None:
    path = tmp_path / "key"
    with pytest.raises(BusError, match="No such file"):
        read_key(path)
    path.write_bytes(b"short")
    with pytest.raises(BusError, match="has 5 bytes; a key has at least 16"):
        read_key(path)
    path.write_bytes(b"0123456789abcdef")
    assert read_key(path) == b"0123456789abcdef"
    # No end of it ever comes.
    with pytest.raises(BusError, match="has too many bytes; a key has at least 16 and"):
        read_key("/dev/zero")


# Faults ----------------------------------------------------------------------------


def test_faults_drop_a_share_and_delay_the_rest() -> None:
    bench = Bench(LinkFaults(drop=0.3, delay=0.03, jitter=0.01, seed=4))
    arrivals: list[tuple[int, bytes]] = []
    bench.bus.subscribe("FAULTY", lambda data, now: arrivals.append((now, data)))
    start = bench.clock.now
    for number in range(1000):
        bench.sender.publish("FAULTY", bytes([number % 256, number // 256]))
        bench.bus.poll()
        bench.clock.now += MS
    for _ in range(50):
        bench.bus.poll()
        bench.clock.now += MS
    delays = [now - start - MS * (d[0] + 256 * d[1]) for now, d in arrivals]
    assert len(arrivals) == pytest.approx(700, abs=60)
    assert min(delays) >= 20 * MS
    assert max(delays) <= 41 * MS
    assert [d for _, d in arrivals] != sorted(d for _, d in arrivals)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"drop": 1.5}, "drop: 1.5; it must be between 0 and 1"),
        ({"delay": -1.0}, "delay: -1; it must be finite and not below 0"),
        ({"delay": float("inf")}, "delay: inf; it must be finite"),
        ({"delay": 0.1, "jitter": 0.2}, "jitter: 0.2; it must be between 0 and"),
    ],
)
def test_faults_that_make_no_sense_are_refused(values, text) -> None:
    with pytest.raises(ValueError, match=text):
        LinkFaults(**values)
