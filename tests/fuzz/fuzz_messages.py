"""LCM messages: accepted as they should be, or counted by reason; nothing raised."""

from __future__ import annotations

from itertools import pairwise
import struct

import atheris

with atheris.instrument_imports(include=["vcbf_drake.hil"]):
    from corpus import run
    from genuine_messages import FORMATS, NOW, genuine

    from vcbf_drake.hil import Inbox, MessageFormat, SimulatedClock

_LENGTH = struct.Struct(">H")


class _Silent:
    """In the place of a bus: what arrives is the fuzzer's."""

    clock = SimulatedClock(NOW)

    def subscribe(self, channel: str, handler: object) -> None:
        pass


def target(data: bytes) -> None:
    """Takes a channel's number, then messages, each with its length before it."""
    if not data:
        return
    form = FORMATS[data[0] % len(FORMATS)]
    accepted = []
    inbox = Inbox(_Silent(), form, 0.1, lambda message, now: accepted.append(message))
    sent = 0
    for message in _split(data[1:]):
        inbox.receive(message, NOW + 1000 * sent)
        sent += 1
    assert inbox.accepted == len(accepted)
    assert sent == len(accepted) + sum(inbox.rejections.values())
    assert inbox.lost >= 0
    for earlier, later in pairwise(accepted):
        if later.session == earlier.session:
            assert later.sequence > earlier.sequence
    for message in accepted:
        _check(form, message)


def _split(data: bytes) -> list[bytes]:
    messages = []
    while len(data) >= _LENGTH.size:
        (length,) = _LENGTH.unpack_from(data)
        data = data[_LENGTH.size :]
        messages.append(data[:length])
        data = data[length:]
    return messages


def _check(form: MessageFormat, message: object) -> None:
    for name, size in form.sizes.items():
        assert getattr(message, name) == size
    for name in form.numbers:
        value = getattr(message, name)
        for number in (value,) if isinstance(value, float) else value:
            assert -1e6 < number < 1e6


def _seed(number: int, form: MessageFormat) -> bytes:
    messages = [genuine(form, NOW, sequence).encode() for sequence in range(3)]
    framed = (_LENGTH.pack(len(each)) + each for each in messages)
    return bytes([number]) + b"".join(framed)


if __name__ == "__main__":
    words = [r"\x7f\xf8\x00\x00\x00\x00\x00\x00", r"\xff\xff\xff\xff"]  # nan, -1
    run(target, [_seed(number, form) for number, form in enumerate(FORMATS)], words)
