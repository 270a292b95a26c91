"""Adaptive cruise control: a problem whose feasibility depends on the volume barrier.

A car follows a slower one and has to keep 1.8 s of headway with brakes and an engine of
at most 0.3 g. The headway barrier alone finally demands more than that: the QP becomes
infeasible. A widened volume barrier brakes in time.

    python examples/adaptive_cruise_control.py
    vcbf-drake run examples/adaptive_cruise_control.py

Constants: Ames, Xu, Grizzle and Tabuada, IEEE Transactions on Automatic Control, 2017.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import (
    Barrier,
    FilterStatus,
    InputLimits,
    Scenario,
    StateFeedback,
    Vehicle,
    VolumeBarrier,
    load_scenario,
    simulate,
)

MASS, GRAVITY, F0, F1, F2 = 1650.0, 9.81, 0.1, 5.0, 0.25  # [kg], [m/s^2], [N], ..
AHEAD, DESIRED, HEADWAY = 14.0, 24.0, 1.8  # [m/s], [m/s], [s]
MOST = 0.3 * MASS * GRAVITY  # [N]

FILTERS = {
    "no volume barrier": {"method": "cbf-qp"},
    "the paper's": {"method": "vcbf-qp", "volume": {"gain": 3.0, "widening": 1.0}},
    # Felt as if there were three times the force, and given way to slowly.
    "widened": {"method": "vcbf-qp", "volume": {"gain": 0.1, "widening": 3.0}},
}


def resistance(speed):
    """Returns what rolling and air take [N]."""
    return F0 + F1 * speed + F2 * speed * speed


@TemplateSystem.define("FollowingCar_")
def FollowingCar_(T):
    """Makes the class FollowingCar_[T] for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """A car: its speed, and its distance from the car ahead."""

        state_names, state_units = ("speed", "distance"), ("m/s", "m")
        input_names, input_units = ("force",), ("N",)

        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._force = self.DeclareVectorInputPort("input", 1)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(2))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            speed, _ = context.get_continuous_state_vector().CopyToVector()
            (force,) = self._force.Eval(context)
            rates = [(force - resistance(speed)) / MASS, AHEAD - speed]
            derivatives.get_mutable_vector().SetFromVector(np.array(rates))

    return Impl


@dataclass
class Follower(Vehicle):
    """A car behind a slower one.

    Attributes:
        gain: K of the headway's barrier [1/s].
    """

    gain: float = 5.0
    position = (1,)

    def make_plant(self):
        """Returns the car."""
        return FollowingCar_[None]()

    def make_controller(self, target):
        """Returns what holds the desired speed, and knows nothing of a car ahead."""

        def law(x):
            return [resistance(x[0]) + 0.8 * MASS * (DESIRED - x[0])]

        return StateFeedback(law, 2, 1)

    def barriers(self):
        """Returns the headway, h = D - 1.8 v [m]."""
        return [
            Barrier(lambda x, t, p: x[1] - HEADWAY * x[0], [self.gain], name="headway")
        ]


def scenario():
    """Returns the published start; the target is the distance that h = 0 ends at."""
    return Scenario(
        description="A car keeps its headway from a slower one, with a weak brake.",
        vehicle=Follower(),
        input_set=InputLimits([-MOST], [MOST]),
        volume=VolumeBarrier(gain=3.0, widening=1.0),
        initial_state=[20.0, 100.0],
        target=[HEADWAY * AHEAD],
        infeasible="stop",
        duration=40.0,
    )


def main() -> None:
    """Drives with each filter, and prints when it had no input left."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="8 s only, for a check")
    duration = 8.0 if parser.parse_args().short else 40.0

    from pictures import COLORS  # Beside this file, which any command may load.

    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots(2, sharex=True)
    for (name, settings), color in zip(FILTERS.items(), COLORS, strict=False):
        log = simulate(load_scenario(__file__, {"duration": duration, **settings})).log
        time, (speed, distance) = log["time"], log["state"].T
        h = distance - HEADWAY * speed
        empty = time[log["status"].ravel() >= FilterStatus.INFEASIBLE]
        kept = f"always an input, min h {h.min():.3f} m, at last {speed[-1]:.2f} m/s"
        lost = f"no input left at {empty[0]:.2f} s" if len(empty) else ""
        print(f"{name}: {lost or kept}")
        axes[0].plot(time, h, label=name, color=color)
        force = log["input"].ravel() / (MASS * GRAVITY)
        axes[1].step(time, force, where="post", color=color)
        if len(empty):
            axes[0].plot(empty[0], np.interp(empty[0], time, h), "kx")
    axes[0].axhline(0.0, color="black", lw=0.6)
    axes[0].set(ylabel="h = D - 1.8 v [m]", xlim=(4.0, 20.0), ylim=(-3.0, 25.0))
    axes[0].legend()
    axes[1].set(xlabel="time [s]", ylabel="force / weight [-]")
    out = Path("out/examples/adaptive_cruise_control.png")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    main()
