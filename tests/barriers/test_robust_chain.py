"""Barriers that a disturbance reaches before the input: a mass with a slow actuator."""

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import BasicVector_, DiagramBuilder, LeafSystem_
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from pydrake.systems.scalar_conversion import TemplateSystem
import pytest

from tests.helpers.row_gradients import row_gradients
from vcbf_drake import (
    AddSafetyFilter,
    ControlAffineModel,
    DisturbanceSource,
    InputSet,
    ModelError,
    SphereObstacle,
)
from vcbf_drake.barriers import BarrierSet, HalfSpace, PerceivedSpheres
from vcbf_drake.disturbances import Sinusoid
from vcbf_drake.safety import FilterSettings, FilterStatus

RATES = np.array([4.0, 3.0, 2.0])  # Decay rates, the largest first [1/s].
GAINS = np.poly(-RATES)[1:]
BOUND, SMOOTHING = 0.4, 0.01


@TemplateSystem.define("SlowActuators_")
def SlowActuators_(T):
    class Impl(LeafSystem_[T]):
        """A mass in the plane: the input moves its acceleration, wind adds to it."""

        state_names = ("x", "y", "vx", "vy", "ax", "ay")

        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._input = self.DeclareVectorInputPort("input", BasicVector_[T](2))
            self._wind = self.DeclareVectorInputPort("disturbance", BasicVector_[T](2))
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(6))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            x = context.get_continuous_state_vector().CopyToVector()
            wind, u = self._wind.Eval(context), self._input.Eval(context)
            rate = np.concatenate([x[2:4], x[4:6] + wind, u])
            derivatives.get_mutable_vector().SetFromVector(rate)

    return Impl


SlowActuators = SlowActuators_[None]


@pytest.fixture(scope="module")
def model():
    return ControlAffineModel.from_system(SlowActuators())


def test_the_plain_barrier_is_refused_and_the_cure_named(model):
    wall = HalfSpace([1.0, 0.0]).barrier(GAINS)
    with pytest.raises(ModelError, match=r"take barrier\.robust_to\(bound\)"):
        BarrierSet(model, [wall])
    BarrierSet(model, [wall.robust_to(BOUND)])


def test_rows_of_a_wall_by_hand(model):
    """Of h = x the only margin is a constant: |E' grad phi_1| = 1, at level 2."""
    wall = HalfSpace([1.0, 0.0]).barrier(GAINS).robust_to(BOUND, SMOOTHING)
    barriers = BarrierSet(model, [wall])
    l1, l2, l3 = RATES
    for state in np.random.default_rng(0).normal(size=(5, 6)):
        x, v, a = state[[0, 2, 4]]
        level = a + (l1 + l2) * v + l1 * l2 * x - BOUND * np.sqrt(1 + SMOOTHING**2)
        rows = barriers.rows(state, 0.0)
        assert rows.value[0] == pytest.approx(x)
        assert rows.chain[0] == pytest.approx([x, v + l1 * x, level])
        assert rows.A[0] == pytest.approx([-1.0, 0.0])
        assert rows.b[0] == pytest.approx((l1 + l2) * a + l1 * l2 * v + l3 * level)
        assert rows.w[0] == pytest.approx([l1 + l2, 0.0])


def test_without_a_bound_the_row_is_the_plain_one(model):
    """Of the same plant without a disturbance, where nothing is early."""
    moving = SphereObstacle([3.0, 1.0], 0.5, velocity=[0.2, -0.1], form="squared")
    ball = moving.barrier(GAINS)
    calm = ControlAffineModel(
        model.state,
        np.array(model.dynamics.f),
        np.array(model.dynamics.g),
        np.zeros((6, 0)),
        position=(0, 1),
    )
    state = np.array([0.1, 0.2, 0.3, -0.4, 0.5, 0.6])
    robust = BarrierSet(model, [ball.robust_to(0.0)]).rows(state, 1.3)
    for plain in (ball, ball.robust_to(1.0)):  # Nothing is early in a calm.
        rows = BarrierSet(calm, [plain]).rows(state, 1.3)
        assert robust.A == pytest.approx(rows.A)
        assert robust.b == pytest.approx(rows.b)
        assert row_gradients(robust).A == pytest.approx(row_gradients(rows).A)
        assert row_gradients(robust).b == pytest.approx(row_gradients(rows).b)
        assert robust.chain[0] == pytest.approx(rows.chain[0])


def test_levels_bound_their_rates_for_every_wind(model):
    """d/dt phi_(k-1) >= phi_k - lambda_k phi_(k-1), by differences; met for some d."""
    ball = SphereObstacle([2.0, 0.5], 0.5).barrier(GAINS).robust_to(BOUND)
    barriers = BarrierSet(model, [ball])
    rng, step = np.random.default_rng(1), 1e-6
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    for state in rng.normal(size=(5, 6)):
        chain = barriers.rows(state, 0.0).chain[0]
        excess = []
        for wind in BOUND * np.stack([np.cos(angles), np.sin(angles)], axis=1):
            rate = np.concatenate([state[2:4], state[4:6] + wind, np.zeros(2)])
            ahead, behind = (
                barriers.rows(state + s * rate, 0.0).chain[0] for s in (step, -step)
            )
            slope = (ahead - behind) / (2.0 * step)
            excess.append(slope[:2] - (chain[1:] - RATES[:2] * chain[:2]))
        assert np.min(excess) > -1e-6
        assert np.min(excess, axis=0) == pytest.approx([0.0, 0.0], abs=0.01)


def test_a_slow_actuator_keeps_off_a_wall_in_the_worst_wind():
    """Pushed at a wall, in a wind that is at its worst again and again."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(SlowActuators())
    wish = builder.AddSystem(ConstantVectorSource([-5.0, 0.0]))
    wind = builder.AddSystem(
        DisturbanceSource([Sinusoid([-BOUND, 0.0], 0.9, 0.5 * np.pi)], 8.0)
    )
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    wall = HalfSpace([1.0, 0.0]).barrier(GAINS, name="wall")
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=wish.get_output_port(),
        barriers=[wall.robust_to(wind.bounds.delta1)],
        input_set=InputSet.box([-40.0, -40.0], [40.0, 40.0]),
        bounds=wind.bounds,
        settings=FilterSettings(period=0.01),
    )
    log = LogVectorOutput(plant.get_output_port(), builder)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, 0.01)
    simulator = Simulator(builder.Build())
    fixed = SimulatorConfig(max_step_size=0.005, use_error_control=False)
    ApplySimulatorConfig(fixed, simulator)
    context = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(context).SetContinuousState([3.0] + [0.0] * 5)
    simulator.AdvanceTo(8.0)
    x = log.FindLog(context).data()[0]
    assert 0.0 <= x.min() < 0.2
    assert status.FindLog(context).data().max() <= FilterStatus.RELAXED


def test_perceived_spheres_can_be_robust_too(model):
    spheres = PerceivedSpheres(capacity=2, dimensions=2, form="squared")
    barriers = [each.robust_to(BOUND) for each in spheres.barriers(GAINS)]
    ball = SphereObstacle([2.0, 0.5], 0.5, velocity=[0.1, 0.0], form="squared")
    slots = spheres.pack([[2.0, 0.5]], [[0.1, 0.0]], [0.5])
    state = np.array([0.1, 0.2, 0.3, -0.4, 0.5, 0.6])
    seen = BarrierSet(model, barriers).rows(state, 0.0, slots)
    known = BarrierSet(model, [ball.barrier(GAINS).robust_to(BOUND)]).rows(state, 0.0)
    assert seen.b[0] == pytest.approx(known.b[0])
    assert seen.A[0] == pytest.approx(known.A[0])
    assert seen.b[1] == 1.0


def test_a_wrong_relative_degree_is_still_seen(model):
    wall = HalfSpace([1.0, 0.0]).barrier([3.0, 2.0]).robust_to(BOUND)
    with pytest.raises(ModelError, match="its relative degree is 3: give 3 gains"):
        BarrierSet(model, [wall])
    with pytest.raises(ValueError, match="bound"):
        wall.robust_to(-1.0)
    with pytest.raises(ValueError, match="smoothing"):
        wall.robust_to(1.0, 0.0)
