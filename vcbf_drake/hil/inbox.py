"""From bytes on a channel to the newest message that may be acted on.

Anyone can write on the bus. Nothing here raises, and nothing here takes more memory
than a message has bytes, whatever the bytes are.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
import math
import struct
from typing import Any

from vcbf_drake.hil.bus import SIGNATURE_BYTES, VERSION, Bus
from vcbf_drake.hil.messages import (
    vcbf_command,
    vcbf_obstacles,
    vcbf_state,
    vcbf_status,
)
from vcbf_drake.hil.senders import (
    LONGEST_ROUND_TRIP,
    PeerClock,
    Reason,
    Rejection,
    Sender,
)
from vcbf_drake.safety import FilterStatus

# No state or input is as large as this, in SI units.
_MAX_NUMBER, _MAX_BYTES = 1e6, 65_536
# What grows as long as a vehicle runs, and how far: 1 MN for eleven days.
_GROWING, _MAX_GROWN = ("time", "input_integral"), 1e12
# How many senders are remembered, so that their past is not taken for news.
_MOST_SENDERS = 8
_LATE = (Reason.OLD, Reason.OVERTAKEN)

# What a message tells of a message of ours: when that was sent by our clock, and how
# long before this message it came [us]; None if it tells of none of ours.
Echo = Callable[[Any], tuple[int, int] | None]


class CommandMode(IntEnum):
    """What a command asks of the vehicle."""

    APPLY = 0
    """Apply the input."""
    HOLD = 1
    """Apply the input; it is held, because the state it rests on is old."""
    FALLBACK = 2
    """Use the vehicle's own fallback; the status says why."""
    END = 3
    """The same, because the controller ends."""


class VehicleMode(IntEnum):
    """What a vehicle does."""

    WAITING = 0
    """It stands, until a first command comes."""
    FOLLOWING = 1
    """It applies the commands that come."""
    FALLBACK = 2
    """It zeroes its input or brakes, for no command came or one asked for it."""
    ENDED = 3
    """Nothing more: this is its last message."""


@dataclass(frozen=True)
class MessageFormat:
    """What a message on a channel has to look like.

    Attributes:
        channel: The channel's name.
        type: The class that lcm-gen made.
        sizes: The value of every field that is the size of an array.
        codes: Fields that are codes 0, 1, ..., and how many codes there are.
        gaps: Fields whose numbers may be nan; all others are finite.
        last_mode: The mode of a sender's last message, where it has one.
    """

    channel: str
    type: Any
    sizes: dict[str, int]
    codes: dict[str, int] = field(default_factory=dict)
    gaps: tuple[str, ...] = ()
    last_mode: int | None = None

    @property
    def numbers(self) -> tuple[str, ...]:
        """The fields that hold finite numbers."""
        fields = zip(self.type.__slots__, self.type.__typenames__, strict=True)
        return tuple(n for n, t in fields if t == "double" and n not in self.gaps)

    def decode(self, data: bytes) -> Any | Rejection:
        """Returns the message, or why it must not be acted on."""
        if len(data) > _MAX_BYTES:
            return Rejection(Reason.LENGTH, f"{len(data)} bytes")
        try:
            message = self.type.decode(data)
        except struct.error:
            return Rejection(Reason.LENGTH)
        except ValueError:
            return Rejection(Reason.TYPE)
        spare = len(data) - len(message.encode())
        if spare == SIGNATURE_BYTES:
            words = "as if it were signed; no key_file is set here"
            return Rejection(Reason.LENGTH, words)
        if spare:
            return Rejection(Reason.LENGTH)
        fault = next(self._faults(message), None)
        return message if fault is None else fault

    def is_last(self, message: Any) -> bool:
        """Returns whether its sender ends with it."""
        return self.last_mode is not None and message.mode == self.last_mode

    def _faults(self, message: Any) -> Iterator[Rejection]:
        if message.version != VERSION:
            found = f"{message.version}, ours is {VERSION}"
            yield Rejection(Reason.VERSION, found)
        for name, size in self.sizes.items():
            if getattr(message, name) != size:
                found = f"{name} is {getattr(message, name)}, not {size}"
                yield Rejection(Reason.SIZE, found)
        if not _has_its_sizes(message):
            yield Rejection(Reason.SIZE)
        for name in self.numbers:
            limit = _MAX_GROWN if name in _GROWING else _MAX_NUMBER
            # Not below it is nan, too.
            if not all(abs(each) < limit for each in _numbers(message, name)):
                yield Rejection(Reason.NUMBER, name)
        for name in self.gaps:
            if any(map(math.isinf, _numbers(message, name))):
                yield Rejection(Reason.NUMBER, name)
        for name, n in self.codes.items():
            if not 0 <= getattr(message, name) < n:
                yield Rejection(Reason.CODE, f"{name} {getattr(message, name)}")
        measured = getattr(message, "utime_measured", message.utime)
        is_ordered = message.session > 0 and message.sequence >= 0
        if not (is_ordered and 0 < measured <= message.utime):
            yield Rejection(Reason.STAMPS)
        if getattr(message, "time", 0.0) < 0.0:
            yield Rejection(Reason.STAMPS, "time is negative")


def _numbers(message: Any, name: str) -> Iterator[float]:
    value = getattr(message, name)
    yield from (value,) if isinstance(value, float) else value


def _has_its_sizes(message: Any) -> bool:
    """Whether arrays are as long as said: a negative length decodes as none."""
    return all(
        len(getattr(message, name)) == getattr(message, sizes[0])
        for name, sizes in zip(message.__slots__, message.__dimensions__, strict=True)
        if sizes
    )


def state_format(num_states: int, num_inputs: int) -> MessageFormat:
    """Returns the format of a vehicle's states."""
    return MessageFormat(
        "VCBF_STATE",
        vcbf_state,
        sizes={"num_states": num_states, "num_inputs": num_inputs},
        codes={"mode": len(VehicleMode)},
        last_mode=VehicleMode.ENDED,
    )


def command_format(num_inputs: int) -> MessageFormat:
    """Returns the format of commands."""
    return MessageFormat(
        "VCBF_COMMAND",
        vcbf_command,
        sizes={"num_inputs": num_inputs},
        codes={"mode": len(CommandMode)},
        last_mode=CommandMode.END,
    )


def status_format(
    num_inputs: int, num_barriers: int, num_disturbances: int
) -> MessageFormat:
    """Returns the format of a filter's status."""
    return MessageFormat(
        "VCBF_STATUS",
        vcbf_status,
        sizes={
            "num_inputs": num_inputs,
            "num_barriers": num_barriers,
            "num_disturbances": num_disturbances,
        },
        codes={"mode": len(CommandMode), "filter_status": len(FilterStatus)},
        # Before the first state, or before a round trip, these are nan.
        gaps=(
            *("state_age", "reference", "slack", "volume", "barriers"),
            *("disturbance_estimate", "error_bound", "disturbance_bound"),
            *("clock_offset", "clock_uncertainty"),
        ),
    )


def obstacles_format() -> MessageFormat:
    """Returns the format of a vehicle's obstacles, however many."""
    return MessageFormat("VCBF_OBSTACLES", vcbf_obstacles, sizes={})


class Inbox:
    """The newest message of the sender that is followed; all others are counted.

    Beyond what `MessageFormat.decode` checks, a message must be newer than the last one
    of its sender, in its own time too, and not be too old by the sender's `PeerClock`.

    One sender is followed at a time, by its session. Another one, whether it began
    earlier or later, is taken only when that one has been silent for `silence`, or has
    said farewell, or when the other one takes over openly (and began later). So neither
    a second sender nor a stray message locks the first one out.

    Args:
        bus: Where messages come from.
        message_format: What they have to look like.
        max_age: How old they may be when they arrive [s].
        on_accept: Called with an accepted message and the time of its arrival [us].
        silence: See above [s]; `max_age` by default.
        max_clock_offset: How far the sender's clock may be from ours [s].
        echo: What a message tells of ours; without, only one way is measured.
        refusal: Why a message that is well formed is not for us; None if it is.

    Attributes:
        newest: The newest message, None before the first.
        received_at: When it arrived [us].
        followed_since: Since when its sender is followed [us].
        accepted: How many were accepted.
        lost: How many sequence numbers never came.
        rejections: How many were rejected, by reason.
        last_rejection: Why the last one was, in words; empty if none was.
        last_rejected_at: When [us]; 0 if none was.
        round_trips: How long the last 65 536 messages of ours that the sender tells of
            were on their way, and what tells of them [ms].
    """

    def __init__(
        self,
        bus: Bus,
        message_format: MessageFormat,
        max_age: float,
        on_accept: Callable[[Any, int], None] | None = None,
        *,
        silence: float | None = None,
        max_clock_offset: float = 60.0,
        echo: Echo = lambda message: None,
        refusal: Callable[[Any], Reason | None] = lambda message: None,
    ) -> None:
        self.newest: Any = None
        self.received_at = self.followed_since = 0
        self.round_trips: deque[float] = deque(maxlen=65_536)
        self._echoed_at = 0
        self._format = message_format
        self._max_age = round(1e6 * max_age)
        self._silence = round(1e6 * (max_age if silence is None else silence))
        self._max_offset = round(1e6 * max_clock_offset)
        self._on_accept, self._echo, self._refusal = on_accept, echo, refusal
        self._senders: OrderedDict[int, Sender] = OrderedDict()
        self._followed: Sender | None = None
        self._start_counting()
        bus.subscribe(message_format.channel, self.receive)

    def _start_counting(self) -> None:
        self.accepted = self.lost = 0
        self.rejections: Counter[Reason] = Counter()
        self.last_rejection, self.last_rejected_at = "", 0

    @property
    def late(self) -> int:
        """How many came too old, or after a newer one."""
        return sum(self.rejections[reason] for reason in _LATE)

    @property
    def rejected(self) -> int:
        """How many were rejected for other reasons than being late."""
        return sum(self.rejections.values()) - self.late

    @property
    def peer_clock(self) -> PeerClock | None:
        """The clock of the sender that is followed, None before the first message."""
        return None if self._followed is None else self._followed.clock

    def utime(self, peer_utime: int) -> int:
        """Returns the time by our clock of a time by the followed sender's [us]."""
        clock = self.peer_clock
        return peer_utime if clock is None else peer_utime - clock.offset

    def has_same_sender(self, message: Any) -> bool:
        """Returns whether our newest message and this one are of one session."""
        both = self.newest is not None and message is not None
        return both and bool(message.session == self.newest.session)

    def begin_anew(self) -> None:
        """Forgets all that came."""
        self.newest, self.received_at = None, 0
        self._senders.clear()
        self._followed = None
        self._start_counting()

    def complaint(self, now: int) -> str:
        """Returns what was wrong with what came in the last second; empty for nothing.

        Args:
            now: The time [us].
        """
        count = self.rejections.total()
        if not count or now - self.last_rejected_at > 1_000_000:
            return ""
        return f"{count} rejected, the last: {self.last_rejection}"

    def report(self) -> dict[str, Any]:
        """Returns how messages arrived, and what is known of their sender's clock."""
        clock = self.peer_clock
        return {
            "clock_offset_ms": None if clock is None else 1e-3 * clock.offset,
            "clock_steps": 0 if clock is None else clock.steps,
            "accepted": self.accepted,
            "lost": self.lost,
            "late": self.late,
            "rejected": {why.value: count for why, count in self.rejections.items()},
        }

    def receive(self, data: bytes | None, now: int) -> None:
        """Takes whatever bytes came at the time `now` [us]; None are unsigned ones."""
        unsigned = Rejection(Reason.SIGNATURE)
        message = unsigned if data is None else self._format.decode(data)
        fault = message if isinstance(message, Rejection) else self._judge(message, now)
        if fault is not None:
            self._refuse(fault, now)
            return
        self.newest, self.received_at = message, now
        self.accepted += 1
        self._add_round_trip(message, now)
        if self._on_accept is not None:
            self._on_accept(message, now)

    def _judge(self, message: Any, now: int) -> Rejection | None:
        """Follows the message's sender, or returns why it is not acted on."""
        reason = self._refusal(message)
        if reason is not None:
            return Rejection(reason)
        sender = self._senders.get(message.session) or Sender(message, now)
        fault = self._meet(sender, message, now)
        if fault is None:
            fault = sender.fault(message, now, self._echo(message), self._max_age)
            if self._followed is sender:
                self.lost = max(0, self.lost + sender.skipped)
        if fault is None:
            self._follow(sender, now)
        return fault

    def _meet(self, sender: Sender, message: Any, now: int) -> Rejection | None:
        """Returns why a sender is not listened to."""
        ahead = message.utime - now
        if abs(ahead) > self._max_offset:
            off = f"{1e-6 * abs(ahead):.1f} s {'ahead' if ahead > 0 else 'behind'}"
            most = f"max_clock_offset is {1e-6 * self._max_offset:g} s"
            reason = Reason.FUTURE if ahead > 0 else Reason.PAST
            return Rejection(reason, f"its clock is {off}; {most}")
        followed = self._followed
        if followed is None or sender is followed:
            return None
        has_ended = self._format.is_last(self.newest)
        is_silent = now - followed.heard_at >= self._silence
        takes_over = getattr(message, "takes_over", False)
        overrules = takes_over and message.session > followed.session
        if has_ended or is_silent or overrules:
            return None
        return Rejection(Reason.SESSION)

    def _follow(self, sender: Sender, now: int) -> None:
        if sender is not self._followed:
            self._followed, self.followed_since = sender, now
        self._senders[sender.session] = sender
        self._senders.move_to_end(sender.session)
        while len(self._senders) > _MOST_SENDERS:
            self._senders.popitem(last=False)

    def _add_round_trip(self, message: Any, now: int) -> None:
        """Adds one when a message of ours is first told of, if it makes sense."""
        sent, age = self._echo(message) or (0, 0)
        if sent > self._echoed_at:
            self._echoed_at, away = sent, now - sent - age
            if 0 <= away < LONGEST_ROUND_TRIP:
                self.round_trips.append(1e-3 * away)

    def _refuse(self, rejection: Rejection, now: int) -> None:
        self.rejections[rejection.reason] += 1
        self.last_rejection, self.last_rejected_at = rejection.words, now
