"""One channel's inbox: what is taken, what is not, and that all of it is counted."""

from __future__ import annotations

from pydrake.lcm import DrakeLcm
import pytest

from vcbf_drake.hil import Bus, Inbox, LinkFaults, Outbox, Reason, SimulatedClock
from vcbf_drake.hil.decoding import command_format
from vcbf_drake.hil.messages import vcbf_command

FORM = command_format(2)
MS = 1000  # In microseconds.


class Bench:
    """An inbox, and whoever sends to it."""

    def __init__(self, faults: LinkFaults | None = None) -> None:
        self.clock = SimulatedClock()
        lcm = DrakeLcm("memq://")
        self.bus = Bus(lcm, self.clock, faults)
        self.sender = Bus(lcm, self.clock)
        self.accepted: list[int] = []
        self.inbox = Inbox(
            self.bus, FORM, 0.1, lambda message, now: self.accepted.append(message)
        )
        self.clock.now += 1000 * MS

    def receive(self, sequence: int, age: int = 0, session: int | None = None) -> None:
        message = vcbf_command()
        message.version, message.sequence = 1, sequence
        message.utime = self.clock.now - age
        message.session = self.sender.session if session is None else session
        message.num_inputs, message.input = 2, [0.5, -0.5]
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


def test_a_sender_that_starts_again_is_followed_and_its_past_is_not() -> None:
    bench = Bench()
    bench.receive(70)
    bench.receive(0, session=bench.clock.now)
    bench.receive(71)
    bench.receive(1, session=bench.clock.now)
    assert bench.sequences == [70, 0, 1]
    assert bench.inbox.rejections == {Reason.SESSION: 1}
    assert bench.inbox.lost == 0


def test_a_leap_of_the_sequence_costs_no_memory() -> None:
    bench = Bench()
    bench.receive(0)
    bench.receive(10**12, session=1)  # Earlier than the session that is known.
    assert bench.inbox.rejections == {Reason.SESSION: 1}
    other = Bench()
    other.receive(0, session=1)
    other.receive(10**12, session=1)
    assert other.sequences == [0, 10**12]
    assert other.inbox.lost == 10**12 - 1


def test_outbox_numbers_and_stamps() -> None:
    bench = Bench()
    outbox = Outbox(bench.sender, FORM.channel)
    for _ in range(3):
        message = vcbf_command()
        message.num_inputs, message.input = 2, [0.0, 0.0]
        outbox.send(message)
        bench.clock.now += MS
    assert bench.bus.poll() == 3
    assert bench.sequences == [0, 1, 2]
    assert outbox.sent == 3
    assert bench.inbox.newest.session == bench.sender.session
    assert bench.inbox.newest.utime == bench.clock.now - MS
    bench.sender.begin_session()
    outbox.send(message)
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
        ({"drop": 1.5}, "drop is 1.5; it must be between 0 and 1"),
        ({"delay": -1.0}, "delay is -1 s; it must not be below 0"),
        ({"delay": 0.1, "jitter": 0.2}, "jitter is 0.2 s; it must be between 0 and"),
    ],
)
def test_faults_that_make_no_sense_are_refused(values, text) -> None:
    with pytest.raises(ValueError, match=text):
        LinkFaults(**values)
