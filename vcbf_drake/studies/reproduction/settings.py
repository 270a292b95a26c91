"""Settings: how much of the reproduction is run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How many trials each part takes; single runs are the same in all.

    Attributes:
        quick: Whether this is a check rather than evidence.
        trials: Pairs of trials in each case of Table I.
        blimp_courses: Random courses of the blimp.
        car_courses: Random courses of the car, each driven at every approach gain.
        chatter_trials: Pairs of trials for each observer of the counter-example.
        ablation_trials: Trials for each set of corrections.
        knob_trials: Trials for each value of a knob.
    """

    quick: bool = False
    trials: int = 200
    blimp_courses: int = 600
    car_courses: int = 60
    chatter_trials: int = 6
    ablation_trials: int = 24
    knob_trials: int = 8


FULL = Settings()
QUICK = Settings(
    quick=True,
    trials=8,
    blimp_courses=12,
    car_courses=3,
    chatter_trials=1,
    ablation_trials=3,
    knob_trials=1,
)
