"""What every test starts from: signals and Drake's log as a terminal has them."""

from __future__ import annotations

from collections.abc import Iterator
import logging
import signal

import pytest

from vcbf_drake import environment


def pytest_configure() -> None:
    """A shell's background job ignores Ctrl-C, and so would what tests start."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def drakes_log() -> Iterator[None]:
    """Gives back the filters that a command in this process put on Drake's log."""
    yield
    log = logging.getLogger("drake")
    for each in log.filters.copy():
        if getattr(each, "__module__", "") == environment.__name__:
            log.removeFilter(each)
