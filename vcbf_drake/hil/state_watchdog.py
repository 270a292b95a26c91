"""StateWatchdog: whether the newest state may still be acted on, and if not, why."""

from __future__ import annotations

import math
from typing import NamedTuple

from vcbf_drake.hil.clock import Clock
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.hil.modes import CommandMode
from vcbf_drake.simulation.scenario import Hardware


class Verdict(NamedTuple):
    """What to ask of the vehicle, and why; the reason is empty with APPLY."""

    mode: CommandMode
    reason: str


class StateWatchdog:
    """Looks at the age of the newest state.

    A state older than `Hardware.max_state_age` is not acted on: the last command is
    held for `Hardware.hold_time`, then the vehicle has to use its own fallback, until a
    state comes again.

    Args:
        states: The states that came.
        clock: Tells the time.
        settings: How old is too old.
    """

    def __init__(self, states: Inbox, clock: Clock, settings: Hardware) -> None:
        self._states, self._clock, self._settings = states, clock, settings

    def state_age(self) -> float:
        """Returns the age of the newest state [s], infinite before the first."""
        if self._states.newest is None:
            return math.inf
        return 1e-6 * (self._clock.utime() - self._states.newest.utime_measured)

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        age, limit = self.state_age(), self._settings.max_state_age
        if age <= limit:
            return Verdict(CommandMode.APPLY, "")
        if age <= limit + self._settings.hold_time:
            reason = f"the state is {age:.2f} s old; the input is held"
            return Verdict(CommandMode.HOLD, reason)
        return Verdict(CommandMode.FALLBACK, f"no new state for {age:.2f} s")
