"""Timeline: when, by the clock, the times of a simulated motion are."""

from __future__ import annotations

from vcbf_drake.hil.clock import Clock


class Timeline:
    """Ties a simulation's time to a clock.

    Args:
        clock: The clock.

    Attributes:
        start: The clock's time at the simulation's time 0 [us].
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.start = clock.utime()

    def restart(self) -> None:
        """Makes now the simulation's time 0."""
        self.start = self._clock.utime()

    def utime(self, time: float) -> int:
        """Returns the clock's time at a simulation's time [us]."""
        return self.start + round(1e6 * time)

    def time(self) -> float:
        """Returns the simulation's time now, by the clock [s]."""
        return 1e-6 * (self._clock.utime() - self.start)
