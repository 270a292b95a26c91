"""V_v's derivatives: against differences, and along the closed loop."""

from pathlib import Path

import numpy as np
from pydrake.geometry.optimization import HPolyhedron
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import LinearSystem
import pytest

from tests.helpers.fixed_set import normalised
from tests.helpers.volume_rate import volume_rate
from vcbf_drake import (
    Blimp,
    ControlAffineModel,
    FilterSettings,
    InputSet,
    SafetyFilter,
    SphereObstacle,
    StateLimit,
)
from vcbf_drake.barriers import BarrierRows, BarrierSet
from vcbf_drake.safety import DisturbanceKnowledge, VolumeBarrier
from vcbf_drake.safety.qp import feasible_set
from vcbf_drake.safety.volume import Volume, VolumeMeasure, volume_row
from vcbf_drake.simulation import load_scenario, make_loop, shipped_scenarios

THRESHOLD = 0.02
INPUTS = InputSet.box([-0.05, -0.2, -0.02], [0.25, 0.2, 0.02])


@pytest.fixture(scope="module")
def blimp():
    model = ControlAffineModel.from_system(Blimp())
    obstacles = [
        SphereObstacle([1.2, 0.3, 0.1], 0.5),
        SphereObstacle([0.9, -0.6, 0.7], 0.3, velocity=[-0.1, 0.05, 0.0]),
        SphereObstacle([0.2, 0.4, -0.9], 0.4),
    ]
    return model, BarrierSet(model, [o.barrier([4.0, 3.0]) for o in obstacles])


def random_situation(rng):
    state = np.concatenate(
        [
            rng.normal(0.0, 0.15, 3),
            [rng.uniform(-0.8, 0.8)],
            rng.normal(0.0, 0.3, 3),
            rng.normal(0.0, 0.3, 1),
        ]
    )
    known = DisturbanceKnowledge(
        estimate=rng.normal(0.0, 0.2, 3),
        rate=rng.normal(0.0, 0.3, 3),
        bound=rng.uniform(0.0, 0.2),
        bound_rate=rng.uniform(-0.4, 0.4),  # A slow linear observer's rises.
        gain=4.0,
    )
    return state, rng.uniform(0.0, 1.0), known


def drake_volume(barriers, state, time, known):
    """V_v by Drake's own ellipsoid, in normalised inputs."""
    feasible = feasible_set(INPUTS, barriers.rows(state, time), known)
    ellipsoid = HPolyhedron(*normalised(feasible)).MaximumVolumeInscribedEllipsoid()
    return 1.0 / np.linalg.det(ellipsoid.A()) - THRESHOLD


def evaluate(barriers, state, time, known):
    feasible = feasible_set(INPUTS, barriers.rows(state, time), known)
    return VolumeMeasure(INPUTS)(feasible).above(THRESHOLD)


def situations(barriers, count):
    """Seeded situations whose feasible set is cut by a barrier but not tiny."""
    rng, found = np.random.default_rng(5), []
    while len(found) < count:
        situation = random_situation(rng)
        feasible = feasible_set(INPUTS, barriers.rows(*situation[:2]), situation[2])
        A, b = normalised(feasible)
        ball = HPolyhedron(A, b)
        cut = np.any(np.linalg.norm(A, axis=1) > b + 1e-3)
        if cut and not ball.IsEmpty() and drake_volume(barriers, *situation) > 0.1:
            found.append(situation)
    return found


def test_value_agrees_with_drake(blimp):
    _, barriers = blimp
    for situation in situations(barriers, 10):
        expected = drake_volume(barriers, *situation)
        assert evaluate(barriers, *situation).value == pytest.approx(expected, abs=1e-6)


def test_every_partial_derivative_agrees_with_central_differences(blimp):
    _, barriers = blimp

    def difference(perturbed, step):
        return (
            drake_volume(barriers, *perturbed(step))
            - drake_volume(barriers, *perturbed(-step))
        ) / (2.0 * step)

    checked = 0
    for state, time, known in situations(barriers, 12):
        exact = evaluate(barriers, state, time, known)
        analytic = [*exact.state, exact.time, *exact.estimate, exact.bound]
        directions = [
            *(
                lambda h, e=e: (state + h * e, time, known)  # noqa: B023
                for e in np.eye(8)
            ),
            lambda h: (state, time + h, known),  # noqa: B023
            *(
                lambda h, e=e: (
                    state,  # noqa: B023
                    time,  # noqa: B023
                    known._replace(estimate=known.estimate + h * e),  # noqa: B023
                )
                for e in np.eye(3)
            ),
            lambda h: (state, time, known._replace(bound=known.bound + h)),  # noqa: B023
        ]
        scale = max(np.abs(analytic).max(), 0.1)
        for value, direction in zip(analytic, directions, strict=True):
            coarse, fine = difference(direction, 2e-4), difference(direction, 1e-4)
            if abs(coarse - fine) > 1e-4 * scale:
                continue  # A row comes into contact in between: no derivative there.
            assert value == pytest.approx(fine, abs=3e-4 * scale)
            checked += 1
    assert checked > 100


def test_plateau_has_no_gradient(blimp):
    model, barriers = blimp
    far = np.zeros(8)
    far[0] = -50.0
    known = DisturbanceKnowledge.constant(3, 0.1)
    exact = evaluate(barriers, far, 0.0, known)
    assert exact.value == pytest.approx(1.0 - THRESHOLD, abs=1e-9)
    assert not exact.state.any()
    row = volume_row(exact, model, far, known, VolumeBarrier(gain=3.0), True, True)
    assert not row.a.any()
    assert row.c == pytest.approx(3.0 * exact.value)


def test_volume_row_is_the_worst_case_of_the_total_derivative(blimp):
    """The row's right side is the least of (E60) over |d - estimate| <= bound."""
    model, barriers = blimp
    rng = np.random.default_rng(3)
    for state, time, known in situations(barriers, 10):
        exact = evaluate(barriers, state, time, known)
        drift, g = model.drift_and_input_matrix(state)
        barrier = VolumeBarrier(gain=3.0)
        row = volume_row(exact, model, state, known, barrier, True, True)
        u = rng.uniform(-0.05, 0.05, 3)
        errors = rng.normal(size=(4000, 3))
        errors *= known.bound / np.linalg.norm(errors, axis=1, keepdims=True)
        rates = [
            volume_rate(
                exact,
                drift + g @ u + model.disturbance_matrix @ (known.estimate + error),
                known,
                known.estimate + error,
            )
            for error in errors
        ]
        worst = (row.c - row.a @ u) * row.unit - 3.0 * exact.value
        assert min(rates) >= worst - 1e-9
        assert min(rates) == pytest.approx(worst, abs=0.02 * (1.0 + abs(worst)))


def closed_loop(fidelity):
    """The measured derivative of V_v along a transient, and two predictions of it.

    Ticks at which the observer's sign function switches are left out: V_v has a kink
    there, between two ticks.
    """
    scenario = load_scenario(
        "blimp-single-obstacle",
        {
            "fidelity": fidelity,
            "period": 1e-3,
            "duration": 0.6,
            # Fast towards the sphere, so that its row cuts the inputs from the start.
            "initial_state": [0.0, 0.0, 0.1, 0.0, 0.15, 0.0, 0.1, 0.0],
        },
    )
    diagram = make_loop(scenario)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.GetSubsystemByName("plant").GetMyMutableContextFromRoot(
        context
    ).SetContinuousState(scenario.initial_state)
    safety_filter = diagram.GetSubsystemByName("filter")
    model = safety_filter.model
    filter_context = safety_filter.GetMyContextFromRoot(context)
    source = diagram.GetSubsystemByName("disturbance")
    plant = diagram.GetSubsystemByName("plant")
    values, total, printed, rates = [], [], [], []
    simulator.Initialize()
    for tick in range(round(scenario.duration / scenario.period)):
        simulator.AdvanceTo(tick * scenario.period)
        now = safety_filter.volume(filter_context)
        known = safety_filter.knowledge(filter_context)
        state = plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(context))
        drift, g = model.drift_and_input_matrix(state)
        u = safety_filter.decision(filter_context).input
        d = source.value(context.get_time())
        rate = drift + g @ u + model.disturbance_matrix @ d
        values.append(now.value)
        total.append(volume_rate(now, rate, known, d))
        printed.append(now.state @ rate + now.time + now.bound * known.bound_rate)
        rates.append(known.rate)
    measured = np.diff(values) / scenario.period
    smooth = np.abs(np.diff(rates, axis=0)).max(axis=1) < 0.5 * scenario.observer.beta
    assert smooth.mean() > 0.9
    return measured[smooth], *(np.array(p)[:-1][smooth] for p in (total, printed))


def relative_error(predicted, measured):
    return np.linalg.norm(predicted - measured) / np.linalg.norm(measured)


def test_corrected_derivative_is_the_one_that_is_measured():
    measured, total, _ = closed_loop("corrected")
    assert np.abs(measured).max() > 0.5  # There is something to predict.
    assert relative_error(total, measured) < 0.02


def test_printed_derivative_is_not_the_one_that_is_measured():
    measured, _, printed = closed_loop("paper")
    assert np.abs(measured).max() > 0.5
    assert relative_error(printed, measured) > 0.1


def test_volume_barrier_refuses_numbers_that_make_no_sense():
    with pytest.raises(ValueError, match=r"gain: -1; it must be .* above 0"):
        VolumeBarrier(gain=-1.0)


class StraightRows:
    """Rows whose numbers [A, b, w] are linear in (x, t), with small w."""

    def __init__(self, rng):
        A = rng.normal(size=(3, 3)) / INPUTS.scale
        b = A @ INPUTS.center + rng.uniform(0.5, 2.0, 3)
        self._offset = np.column_stack([A, b, 0.1 * rng.normal(size=(3, 3))])
        self._slope = rng.normal(size=(3, 7, 3)) * [0.1, 0.1, 0.1]

    def rows(self, x, t):
        numbers = self._offset + self._slope @ np.append(x, t)
        return BarrierRows(
            value=np.ones(3),
            chain=tuple(np.ones(2) for _ in range(3)),
            A=numbers[:, :3],
            b=numbers[:, 3],
            w=numbers[:, 4:],
            num_states=2,
            gradients=lambda rows: self._slope[list(rows)],
        )


def test_rows_that_the_disturbance_hardly_moves_are_differentiated_too():
    """In one random direction of (x, t, estimate, bound) at a time."""
    rng, checked = np.random.default_rng(12), 0
    for _ in range(20):
        barriers = StraightRows(rng)
        known = DisturbanceKnowledge(rng.normal(size=3), np.zeros(3), 0.3, 0.0, 0.0)
        step = rng.normal(size=7)

        def moved(h, known=known, step=step, barriers=barriers):
            known = known._replace(
                estimate=known.estimate + h * step[3:6],
                bound=known.bound + h * step[6],
            )
            return barriers, h * step[:2], h * step[2], known

        exact = evaluate(*moved(0.0))
        if exact.value < 0.05:
            continue
        slope = np.concatenate(
            [exact.state, [exact.time], exact.estimate, [exact.bound]]
        )
        coarse, fine = (
            (drake_volume(*moved(h)) - drake_volume(*moved(-h))) / (2.0 * h)
            for h in (2e-4, 1e-4)
        )
        if slope.any() and abs(coarse - fine) < 1e-4 * abs(fine):
            checked += 1
            assert slope @ step == pytest.approx(fine, rel=3e-3, abs=1e-3)
    assert checked > 5


@pytest.mark.parametrize("moving", ["state", "time", "estimate", "bound", "negative"])
def test_the_plateau_ends_where_any_row_could_take_room_away(moving):
    flat = Volume(0.5, None, np.zeros(4), 0.0, np.zeros(2), 0.0)
    assert flat.is_on_plateau
    changed = {
        "state": {"state": np.array([0.0, 0.0, 1e-9, 0.0])},
        "time": {"time": -0.1},
        "estimate": {"estimate": np.array([0.0, 0.2])},
        "bound": {"bound": -0.3},
        "negative": {"value": -1e-3},
    }
    assert not flat._replace(**changed[moving]).is_on_plateau


def test_the_label_says_what_is_measured():
    assert VolumeBarrier(widening=1.0).label == "volume"
    assert VolumeBarrier().label == "volume, inputs x 8"
    wide = VolumeBarrier(widening=2.5)
    assert wide.label == "volume, inputs x 2.5"


# The default -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("barrier", "widening", "gain"),
    [(VolumeBarrier(), 8.0, 0.1), (VolumeBarrier(gain=3.0, widening=1.0), 1.0, 3.0)],
)
def test_the_default_brakes_where_the_papers_form_is_on_its_plateau(
    barrier, widening, gain
):
    """A mass, x'' = u in [-1, 1], before the end of a rail at 1, by hand.

    With h = 1 - x the row is u <= b = 3 h - 4 v; the widened set is [-kappa, b], or all
    of it, so det B = min(1, (b + kappa) / (2 kappa)), and b' = -3 v - 4 u.
    """
    mass = LinearSystem([[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 1]], [[0], [0]])
    rail = StateLimit(0, upper=1.0).barriers([4.0, 3.0])
    settings = FilterSettings(method="vcbf-qp", volume=barrier)
    inputs = InputSet.box([-1.0], [1.0])
    model = ControlAffineModel.from_system(mass)
    safety_filter = SafetyFilter(model, rail, inputs, settings)
    context = safety_filter.CreateDefaultContext()
    x, v = 0.2, 0.3
    safety_filter.GetInputPort("state").FixValue(context, [x, v])
    safety_filter.GetInputPort("reference").FixValue(context, [1.0])
    b = 3.0 * (1.0 - x) - 4.0 * v
    assert b == pytest.approx(1.2)
    determinant = min(1.0, (b + widening) / (2.0 * widening))
    volume = safety_filter.GetOutputPort("volume").Eval(context)[0]
    assert volume == pytest.approx(determinant - 0.02)
    expected = 1.0
    if determinant < 1.0:  # (-3 v - 4 u) / (2 kappa) >= -lambda V
        expected = (2.0 * widening * gain * (determinant - 0.02) - 3.0 * v) / 4.0
    u = safety_filter.GetOutputPort("command").Eval(context)[0]
    assert u == pytest.approx(expected, abs=1e-9)
    assert (u < 0.0) == (widening > 1.0)


def test_the_default_is_everywhere_and_the_papers_scenarios_say_theirs():
    """The paper's Section V: lambda_Vv = 3, and no widening."""
    assert FilterSettings().volume == VolumeBarrier(None, 0.1, 1000.0, 8.0)
    for name in shipped_scenarios():
        volume = load_scenario(name).volume
        assert (volume.widening, volume.gain) == (1.0, 3.0), name
    arm = Path(__file__).parents[2] / "examples" / "arm.yaml"  # Says nothing of it.
    assert load_scenario(arm).volume == VolumeBarrier()
