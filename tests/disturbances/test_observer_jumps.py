"""Measured states that jump: wraps of angles, resets of an estimator, teleports."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.math import sin
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    LeafSystem,
    LeafSystem_,
)
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from pydrake.systems.scalar_conversion import TemplateSystem
import pytest

from tests.helpers.observer_runs import Bench, DragModel
from vcbf_drake import AddSafetyFilter
from vcbf_drake.barriers import Barrier
from vcbf_drake.checks import Array
from vcbf_drake.disturbances import (
    DisturbanceBounds,
    DisturbanceEstimate,
    DisturbanceSource,
    LinearDisturbanceObserver,
    RiseObserver,
    Sinusoid,
)
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.safety import FilterSettings, FilterStatus, InputSet

OBSERVERS = pytest.mark.parametrize("kind", [RiseObserver, LinearDisturbanceObserver])
PERIOD = 0.02
SIZE, RATE = 0.3, 0.9  # Of the disturbance, in m/s^2 and rad/s.
BOUNDS = DisturbanceBounds(SIZE, SIZE * RATE, SIZE * RATE**2)


@TemplateSystem.define("Boat_")
def Boat_(T: type) -> type:
    class Impl(LeafSystem_[T]):
        """A boat at 1 m/s: y' = sin(heading), heading' = u + d."""

        def _construct(self, converter: Any = None) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            self.DeclareVectorInputPort("input", 1)
            self.DeclareVectorInputPort("disturbance", 1)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(2))

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            _, heading = context.get_continuous_state_vector().CopyToVector()
            (u,) = self.GetInputPort("input").Eval(context)
            (d,) = self.GetInputPort("disturbance").Eval(context)
            derivatives.SetFromVector([sin(heading), u + d])

    return Impl


Boat = Boat_[None]


class Compass(LeafSystem):
    """Measures the boat's state, its heading between -pi and pi."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorInputPort("state", 2)
        self.DeclareVectorOutputPort("measured", 2, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        y, heading = self.get_input_port().Eval(context)
        output.SetFromVector([y, np.arctan2(np.sin(heading), np.cos(heading))])


def westward(named: bool) -> dict[str, Array]:
    """Sails along the wall y = 0 and against it, its heading at the compass's jump."""
    boat, builder = Boat(), DiagramBuilder()
    if named:
        boat.wrapped_states = {"x1": 2.0 * np.pi}
    builder.AddSystem(boat)
    gusts = builder.AddSystem(
        DisturbanceSource([Sinusoid([0.05], frequency=1.1)], 25.0)
    )
    compass = builder.AddSystem(Compass())
    turn = builder.AddSystem(ConstantVectorSource([0.3]))
    builder.Connect(gusts.get_output_port(), boat.GetInputPort("disturbance"))
    builder.Connect(boat.GetOutputPort("state"), compass.get_input_port())
    loop = AddSafetyFilter(
        builder,
        plant=boat,
        reference=turn.get_output_port(),
        barriers=[Barrier(lambda x, t, p: x[0], [3.0, 2.0])],
        input_set=InputSet.box([-0.5], [0.5]),
        bounds=gusts.bounds,
        settings=FilterSettings(period=PERIOD, method="dob-cbf-qp"),
        state=compass.get_output_port(),
    )
    ports = {
        "disturbance": gusts.get_output_port(),
        "state": boat.GetOutputPort("state"),
        "measured": compass.get_output_port(),
        "status": loop.filter.GetOutputPort("status"),
        "estimate": loop.observer.GetOutputPort("estimate"),
    }
    logs = {
        name: LogVectorOutput(port, builder, PERIOD) for name, port in ports.items()
    }
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    context.SetContinuousState([0.3, np.pi - 0.1])
    simulator.AdvanceTo(25.0)
    log = {name: log.FindLog(context).data().T for name, log in logs.items()}
    return log | DisturbanceEstimate.unpack(log["estimate"]).log_arrays()


@pytest.mark.parametrize("named", [True, False])
def test_a_boat_sails_west_along_a_wall(named: bool) -> None:
    """Taken for motion, a wrap gave estimates of 23 for |d| <= 0.05."""
    log = westward(named)
    jumps = np.sum(np.abs(np.diff(log["measured"][:, 1])) > 3.0)
    assert jumps > 3
    assert log["refused_intervals"][-1] == (0 if named else jumps)
    error = np.abs(log["disturbance"] - log["disturbance_estimate"])
    assert np.all(error[:, 0] <= log["error_bound"] + 1e-6)
    assert np.abs(log["disturbance_estimate"]).max() < 0.06
    assert not np.any(log["status"] == FilterStatus.INFEASIBLE)
    assert 0.0 < log["state"][:, 0].min() < 0.05


def disturbance(t: float) -> Array:
    return np.array([SIZE * np.sin(RATE * t + 0.7)])


def speed(t: float) -> float:
    return float(SIZE / RATE * (np.cos(0.7) - np.cos(RATE * t + 0.7)))


@OBSERVERS
@pytest.mark.parametrize("jump", [0.3, -0.3, 50.0])
def test_a_reset_of_the_measured_speed_is_refused(kind, jump: float) -> None:
    """An estimator's correction of 0.3 m/s gave an estimate of 1.4 for |d| <= 0.3."""
    observer = kind(DragModel(1, linear=0.0, cubic=0.0), PERIOD, BOUNDS)
    bench, refused, kept = Bench(observer), [], 0.0
    for k in range(600):
        t = k * PERIOD
        before = bench.output("disturbance_estimate")[0]
        bench.measure(t, np.array([0.0, speed(t) + jump * (k >= 300)]))
        estimate = bench.output("disturbance_estimate")[0]
        bound = bench.estimate().error_bound
        assert abs(disturbance(t)[0] - estimate) <= bound
        if k == 300:
            kept = abs(estimate)
            assert estimate == before
            assert bound == pytest.approx(observer.error_bound(0.0) + kept)
            assert bench.estimate().rate[0] == 0.0
        bench.update()
        refused.append(bench.estimate().refused_intervals)
    assert refused == [0.0] * 300 + [1.0] * 300
    decay = observer.error_bound(0.0) - observer.error_bound(299 * PERIOD)
    again = observer.error_bound(299 * PERIOD) + kept * 1e-9
    assert decay > 0.0
    assert bench.estimate().error_bound == pytest.approx(again, rel=1e-3)


@OBSERVERS
def test_the_bound_after_a_refusal_is_met_from_the_other_side(kind) -> None:
    """A jump hides that d changed its sign: the estimate is off by nearly 2 delta1."""
    still = DisturbanceBounds(0.3, 0.0, 0.0)
    observer = kind(DragModel(1, linear=0.0, cubic=0.0), PERIOD, still)
    bench, v = Bench(observer), 0.0
    for k in range(400):
        d = 0.3 if k < 200 else -0.3
        bench.measure(k * PERIOD, np.array([0.0, v]))
        error = abs(d - bench.output("disturbance_estimate")[0])
        assert error <= bench.estimate().error_bound + 1e-12
        if k == 200:
            assert error == pytest.approx(0.6, abs=1e-6)
        bench.update()
        v += 5.0 if k == 199 else PERIOD * d
    assert bench.estimate().refused_intervals == 1.0


@OBSERVERS
def test_teleports_at_every_tick_never_break_the_bound(kind) -> None:
    observer = kind(DragModel(), PERIOD, BOUNDS)
    bench, generator = Bench(observer), np.random.default_rng(4)
    for k in range(50):
        bench.measure(k * PERIOD, 10.0 * generator.normal(size=4))
        size = np.linalg.norm(bench.output("disturbance_estimate"))
        assert size + BOUNDS.delta1 <= bench.estimate().error_bound
        bench.update()
    assert bench.estimate().refused_intervals == 49.0


@OBSERVERS
def test_noise_within_its_deviation_is_no_jump(kind) -> None:
    """One measurement alone differs by 100 times delta1 T from one tick to the next."""
    noise = 100 * BOUNDS.delta1 * PERIOD
    observer = kind(DragModel(1, linear=0.0, cubic=0.0), PERIOD, BOUNDS, noise=noise)
    bench, generator = Bench(observer), np.random.default_rng(5)
    for k in range(2000):
        bench.measure(k * PERIOD, noise * generator.normal(size=2))
        bench.update()
    assert bench.estimate().refused_intervals == 0.0


def test_wraps_of_the_shipped_headings_are_no_motion() -> None:
    boat = Boat()
    boat.wrapped_states = ["x1"]
    observer = RiseObserver(ControlAffineModel.from_system(boat), PERIOD, BOUNDS)
    turned = 0.2 * PERIOD
    mean = observer.mean_disturbance(
        np.array([0.0, np.pi - turned / 2]),
        np.array([0.0, turned / 2 - np.pi]),
        np.array([0.05]),
        PERIOD,
    )
    np.testing.assert_allclose(mean.disturbance, [0.15], atol=1e-9)


@OBSERVERS
@pytest.mark.parametrize("far", [0.0, 5e6, 1.8e9])
def test_a_large_state_beside_hides_no_jump(kind, far):
    """A position on a map, the seconds since 1970: neither blurs a speed."""
    model = DragModel()
    before = np.array([far, 0.0, 0.5, 0.0])
    after = before + PERIOD * model.nominal_rate(before, np.zeros(2))
    jump = np.array([0.0, 0.0, 0.3, 0.0])  # [m/s], 15 m/s^2 over the interval.
    for measured, refused in ((after, 0.0), (after + jump, 1.0)):
        bench = Bench(kind(model, PERIOD, BOUNDS))
        bench.measure(0.0, before)
        bench.update()
        bench.measure(PERIOD, measured)
        assert bench.estimate().refused_intervals == refused
