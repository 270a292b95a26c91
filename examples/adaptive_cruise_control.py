"""Adaptive cruise control: where the volume barrier decides, and how to choose it.

A car follows one that is slower, and has to keep 1.8 s of headway while brakes and
engine give 0.3 g at most. The headway alone asks for more than that at last: the QP has
no solution then. A volume barrier that feels its rows early brakes in time.

    python examples/adaptive_cruise_control.py

Constants: Ames, Xu, Grizzle and Tabuada, IEEE Transactions on Automatic Control, 2017.
"""

import argparse
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
from pictures import COLORS
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem, LeafSystem_
from pydrake.systems.primitives import LogVectorOutput
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import (
    AddSafetyFilter,
    Barrier,
    FilterSettings,
    FilterStatus,
    InputSet,
    VolumeBarrier,
)

MASS, GRAVITY, F0, F1, F2 = 1650.0, 9.81, 0.1, 5.0, 0.25  # [kg], [m/s^2], [N], ..
AHEAD, DESIRED, HEADWAY = 14.0, 24.0, 1.8  # [m/s], [m/s], [s]
MOST = 0.3 * MASS * GRAVITY  # [N]
START = [20.0, 100.0]  # Speed [m/s], distance [m].
PERIOD = 0.02

FILTERS = {
    "no volume barrier": FilterSettings(period=PERIOD, method="cbf-qp"),
    "the paper's": FilterSettings(
        period=PERIOD, method="vcbf-qp", volume=VolumeBarrier(gain=3.0)
    ),
    # Felt as if there were three times the force, and given way to slowly.
    "widened": FilterSettings(
        period=PERIOD, method="vcbf-qp", volume=VolumeBarrier(gain=0.1, widening=3.0)
    ),
}


@TemplateSystem.define("Follower_")
def Follower_(T):
    """Makes the class Follower_[T] for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """A car: its speed, and its distance from the car ahead."""

        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._force = self.DeclareVectorInputPort("force", 1)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(2))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            speed, _ = context.get_continuous_state_vector().CopyToVector()
            (force,) = self._force.Eval(context)
            resistance = F0 + F1 * speed + F2 * speed * speed
            rates = [(force - resistance) / MASS, AHEAD - speed]
            derivatives.get_mutable_vector().SetFromVector(np.array(rates))

    return Impl


Follower = Follower_[None]


class Cruise(LeafSystem):
    """Holds the desired speed; knows nothing of a car ahead."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("state", 2)
        self.DeclareVectorOutputPort("force", 1, self._calc)

    def _calc(self, context, output):
        speed = self.get_input_port().Eval(context)[0]
        resistance = F0 + F1 * speed + F2 * speed**2
        output[0] = resistance + 0.8 * MASS * (DESIRED - speed)


def headway(x, t, p):
    """Returns h = D - 1.8 v [m]."""
    return x[1] - HEADWAY * x[0]


def drive(settings: FilterSettings, duration: float):
    """Returns times [s], states, ticks [s], forces [N] and statuses of a drive."""
    builder = DiagramBuilder()
    car = builder.AddNamedSystem("car", Follower())
    cruise = builder.AddNamedSystem("cruise", Cruise())
    builder.Connect(car.get_output_port(), cruise.get_input_port())
    safety = AddSafetyFilter(
        builder,
        plant=car,
        reference=cruise.get_output_port(),
        barriers=[Barrier(headway, [5.0], name="headway")],
        input_set=InputSet.box([-MOST], [MOST]),
        settings=settings,
    )
    state = LogVectorOutput(car.get_output_port(), builder)
    ticks = [
        LogVectorOutput(safety.filter.GetOutputPort(name), builder, PERIOD)
        for name in ("command", "status")
    ]
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    car.GetMyMutableContextFromRoot(context).SetContinuousState(START)
    simulator.AdvanceTo(duration)
    path = state.FindLog(context)
    force, status = (log.FindLog(context).data()[0] for log in ticks)
    time = ticks[0].FindLog(context).sample_times()
    return path.sample_times(), path.data(), time, force, status


def main() -> None:
    """Drives with each filter, and prints when it had no input left."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="8 s only, for a check")
    duration = 8.0 if parser.parse_args().short else 40.0

    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots(2, sharex=True)
    for (name, settings), color in zip(FILTERS.items(), COLORS, strict=False):
        time, (speed, distance), ticks, force, status = drive(settings, duration)
        h = distance - HEADWAY * speed
        empty = ticks[status >= FilterStatus.INFEASIBLE]
        lost = f"no input left at {empty[0]:.2f} s" if len(empty) else "always an input"
        print(f"{name}: {lost}; min h {h.min():.3f} m, at last {speed[-1]:.2f} m/s")
        axes[0].plot(time, h, label=name, color=color)
        axes[1].step(ticks, force / (MASS * GRAVITY), where="post", color=color)
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
