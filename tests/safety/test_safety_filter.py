import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
import pytest

from vcbf_drake import (
    AddSafetyFilter,
    Blimp,
    BlimpController,
    Car,
    ControlAffineModel,
    DisturbanceSource,
    InputSet,
    LinearDisturbanceObserver,
    RiseObserver,
    SafetyFilter,
    SphereObstacle,
)
from vcbf_drake.disturbances import DisturbanceBounds, Sinusoid
from vcbf_drake.errors import SolverError
from vcbf_drake.safety import (
    METHODS,
    FilterSettings,
    FilterStatus,
    safety_filter as filter_module,
    unpack_feasible_set,
)
from vcbf_drake.safety.qp import VolumeRow
from vcbf_drake.safety.volume import VolumeBarrier, VolumeMeasure

LIMITS = InputSet.box([-0.05, -0.2, -0.02], [0.25, 0.2, 0.02])
CLOSE = np.array([0.0, 0.0, 0.0, 0.1, 0.25, 0.0, 0.1, 0.0])
FAR = np.array([-50.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def model():
    return ControlAffineModel.from_system(Blimp())


def make_filter(model, delta1=0.0, **options):
    barriers = [
        SphereObstacle([1.0, 0.1, 0.1], 0.5).barrier([4.0, 3.0], name="near"),
        SphereObstacle([9.0, 9.0, 9.0], 0.5).barrier([4.0, 3.0], name="far"),
    ]
    bounds = DisturbanceBounds(delta1, 0.0, 0.0)
    return SafetyFilter(
        model, barriers, LIMITS, FilterSettings(**options), bounds=bounds
    )


def fixed(safety_filter, state, reference=(0.2, 0.0, 0.0), estimate=(0.05, 0.0, 0.0)):
    """A context whose ports hold these values."""
    context = safety_filter.CreateDefaultContext()
    values = {
        "state": state,
        "reference": reference,
        "held_input": np.zeros(3),
        "estimate": [*estimate, 0.1, 0.0, 0.0, 0.05, -0.1, 0.0, 0.0],
    }
    for name, value in values.items():
        if safety_filter.HasInputPort(name):
            safety_filter.GetInputPort(name).FixValue(context, np.array(value, float))
    return context


def evaluate(safety_filter, context, port):
    return safety_filter.GetOutputPort(port).Eval(context)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fidelity", ["corrected", "paper"])
def test_every_method_keeps_its_rows_and_the_input_limits(model, method, fidelity):
    safety_filter = make_filter(model, method=method, fidelity=fidelity, delta1=0.1)
    context = fixed(safety_filter, CLOSE)
    u = evaluate(safety_filter, context, "command")
    packed = unpack_feasible_set(evaluate(safety_filter, context, "feasible_set"), 3)
    # The gains (4, 3) have a last rate of 1, which one method lets grow.
    growth = evaluate(safety_filter, context, "decay")[0] - 1.0
    assert (growth > 0.0) == (method == "optimal-decay")
    levels = evaluate(safety_filter, context, "levels")[1::2]
    b = packed.b.copy()
    if growth > 0.0:
        b += growth * np.append(np.zeros(len(LIMITS.b)), levels)
    assert np.all(packed.A @ u <= b + 1e-9)
    assert LIMITS.contains(u)
    assert evaluate(safety_filter, context, "status")[0] <= FilterStatus.RELAXED


def test_methods_order_by_how_much_they_ask_for(model):
    """Worst case asks for more than an estimate, an estimate for more than nothing."""
    surge = {
        method: evaluate(
            f := make_filter(model, method=method, delta1=0.3),
            fixed(f, CLOSE, estimate=(0.0, 0.0, 0.0)),
            "command",
        )[0]
        for method in ("cbf-qp", "dob-cbf-qp", "robust-cbf-qp")
    }
    assert surge["robust-cbf-qp"] < surge["dob-cbf-qp"] < surge["cbf-qp"] < 0.2


def test_far_from_everything_the_reference_passes_through(model):
    safety_filter = make_filter(model)
    reference = np.array([0.1, 0.1, 0.01]) / 3.0
    context = fixed(safety_filter, FAR, reference)
    assert np.array_equal(evaluate(safety_filter, context, "command"), reference)
    assert evaluate(safety_filter, context, "status")[0] == FilterStatus.REFERENCE
    assert evaluate(safety_filter, context, "volume")[0] == pytest.approx(0.98)


def test_all_ports_share_one_solve(model, monkeypatch):
    calls = []
    original = filter_module.choose_input

    def counting(*arguments):
        calls.append(1)
        return original(*arguments)

    monkeypatch.setattr(filter_module, "choose_input", counting)
    safety_filter = make_filter(model)
    context = fixed(safety_filter, CLOSE)
    for _ in range(3):
        for port in (
            "status",
            "command",
            "slack",
            "volume",
            "barriers",
            "feasible_set",
        ):
            evaluate(safety_filter, context, port)
    assert len(calls) == 1


def test_output_depends_on_the_context_alone(model):
    """The same numbers after other states were evaluated, and in a cloned context."""
    safety_filter = make_filter(model)
    first = evaluate(safety_filter, fixed(safety_filter, CLOSE), "command")
    rng = np.random.default_rng(0)
    for _ in range(20):
        state = CLOSE + rng.normal(0.0, 0.1, 8)
        evaluate(safety_filter, fixed(safety_filter, state), "command")
    context = fixed(safety_filter, CLOSE)
    assert np.array_equal(evaluate(safety_filter, context, "command"), first)
    assert np.array_equal(evaluate(safety_filter, context.Clone(), "command"), first)
    other = make_filter(model)
    assert np.array_equal(evaluate(other, fixed(other, CLOSE), "command"), first)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("method", ["cbf-qp", "dob-vcbf-qp"])
def test_a_state_that_is_not_finite_gives_a_finite_input_and_says_so(
    model, method, bad
):
    safety_filter = make_filter(model, method=method)
    state = CLOSE.copy()
    state[4] = bad
    context = fixed(safety_filter, state)
    assert LIMITS.contains(evaluate(safety_filter, context, "command"))
    assert evaluate(safety_filter, context, "status")[0] == FilterStatus.FAILED
    assert np.isnan(evaluate(safety_filter, context, "volume")[0])


def test_the_centre_of_an_obstacle_is_survived(model):
    safety_filter = make_filter(model)
    state = np.zeros(8)
    state[:3] = [1.0, 0.1, 0.1]
    context = fixed(safety_filter, state)
    assert LIMITS.contains(evaluate(safety_filter, context, "command"))
    assert evaluate(safety_filter, context, "status")[0] == FilterStatus.FAILED


def test_an_empty_set_is_reported_with_its_rows(model):
    barrier = VolumeBarrier(threshold=0.02, widening=1.0)
    safety_filter = make_filter(model, volume=barrier)
    fast = CLOSE.copy()
    fast[4] = 2.0
    context = fixed(safety_filter, fast)
    decision = safety_filter.decision(context)
    assert decision.status == FilterStatus.INFEASIBLE
    assert "near" in [safety_filter.row_names[row] for row in decision.conflict]
    assert LIMITS.contains(decision.input)
    assert evaluate(safety_filter, context, "volume")[0] == pytest.approx(-0.02)
    assert decision.input[0] == pytest.approx(-0.05)  # It brakes as hard as it can.


def test_a_volume_that_cannot_be_verified_is_said_and_its_row_left_out(
    model, monkeypatch
):
    """The barrier rows hold all the same: the QP without a volume row is solved."""

    def fail(solver, A, b):
        raise SolverError("no ellipsoid could be certified", A, b)

    without = make_filter(model, method="dob-cbf-qp")
    expected = evaluate(without, fixed(without, CLOSE), "command")
    safety_filter = make_filter(model)
    monkeypatch.setattr(VolumeMeasure, "largest", fail)
    context = fixed(safety_filter, CLOSE)
    assert np.isnan(evaluate(safety_filter, context, "volume")[0])
    assert evaluate(safety_filter, context, "status")[0] == FilterStatus.FAILED
    np.testing.assert_array_equal(evaluate(safety_filter, context, "command"), expected)


@pytest.mark.parametrize("bound", [-np.inf, np.inf, np.nan])
def test_a_volume_row_beyond_what_floats_hold_is_left_out_too(
    model, monkeypatch, bound
):
    without = make_filter(model, method="dob-cbf-qp")
    expected = evaluate(without, fixed(without, CLOSE), "command")
    row = VolumeRow(np.array([-1.0, 0.3, 0.0]), bound)
    monkeypatch.setattr(filter_module, "volume_row", lambda *_: row)
    safety_filter = make_filter(model)
    context = fixed(safety_filter, CLOSE)
    assert evaluate(safety_filter, context, "status")[0] == FilterStatus.FAILED
    np.testing.assert_array_equal(evaluate(safety_filter, context, "command"), expected)


def test_far_from_everything_the_volume_is_on_its_plateau(model):
    safety_filter = make_filter(model)
    volume = safety_filter.volume(fixed(safety_filter, FAR))
    assert volume.is_on_plateau and volume.time == 0.0 and volume.bound == 0.0
    assert not volume.state.any() and not volume.estimate.any()
    assert volume.state.shape == (8,) and volume.estimate.shape == (3,)


def test_the_weights_of_violations_reach_the_feasible_set(model):
    safety_filter = make_filter(model, violation_weights=[2.0, 5.0])
    feasible = safety_filter.feasible_set(fixed(safety_filter, CLOSE))
    assert feasible.costs.weights.tolist() == [2.0, 5.0]


def test_rows_that_exclude_each_other_are_named(model):
    safety_filter = make_filter(model)
    near = np.array([[1.0, 0.0, 0.0]])
    A = np.vstack([LIMITS.A, near, -near])
    b = np.append(LIMITS.b, [0.1, -0.05])
    assert safety_filter.names_in_conflict(A, b) == ()
    b[-2] = -0.2  # Below the lower limit -0.05; "far" asks for 0.05 at least.
    assert safety_filter.names_in_conflict(A, b) == ("near", "far")
    b[-1] = 0.3
    assert safety_filter.names_in_conflict(A, b) == (
        "lower limit of input 0",
        "near",
    )


def test_rows_are_named_after_what_they_limit(model):
    box = make_filter(model)
    assert [*box.row_names] == [
        *(f"upper limit of input {j}" for j in range(3)),
        *(f"lower limit of input {j}" for j in range(3)),
        "near",
        "far",
    ]
    rows = np.vstack([np.eye(3), [[-1.0, -1.0, -1.0]]])
    wedge = SafetyFilter(model, box.barriers, InputSet(rows, np.full(4, 0.1)))
    names = [*wedge.row_names]
    assert names == [*(f"input limit {i}" for i in range(4)), "near", "far"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"method": "magic"},
            "method: 'magic'; it must be one of cbf-qp, robust",
        ),
        (
            {"fidelity": "exact"},
            "fidelity: 'exact'; it must be one of corrected, ",
        ),
        (
            {"violation_weights": [1.0]},
            r"violation_weights: \[1.0\]; it must be 2 numbers",
        ),
        (
            {"infeasible": "pray"},
            "infeasible: 'pray'; it must be one of stop, least",
        ),
    ],
)
def test_unknown_choices_are_refused_with_what_is_allowed(model, options, message):
    with pytest.raises(ValueError, match=message):
        make_filter(model, **options)


def test_input_set_of_another_size_is_refused(model):
    with pytest.raises(ValueError, match="input_set: 2; it must be 3 inputs"):
        SafetyFilter(model, [], InputSet.box([-1, -1], [1, 1]))


def guarded_blimp(**settings):
    """The loop of a user who wires everything but the filter."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", Blimp())
    controller = builder.AddNamedSystem("pilot", BlimpController([4.0, 0.0, 1.0]))
    wind = builder.AddSystem(DisturbanceSource([Sinusoid([0.05] * 3, 0.8, 0.0)], 10.0))
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("state"))
    added = AddSafetyFilter(
        builder,
        plant=plant,
        reference=controller.GetOutputPort("reference"),
        barriers=[SphereObstacle([2.0, 0.1, 0.5], 0.5).barrier([4.0, 3.0])],
        input_set=InputSet.box([-0.1, -0.1, -0.01], [0.1, 0.1, 0.01]),
        bounds=wind.bounds,
        settings=FilterSettings(**settings),
    )
    log = LogVectorOutput(added.filter.GetOutputPort("barriers"), builder, 0.02)
    return builder.Build(), added, log


def test_the_fallbacks_and_the_observer_read_what_the_hold_puts_out():
    diagram, added, _ = guarded_blimp()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.5)
    held, seen, observed = (
        port.Eval(system.GetMyContextFromRoot(simulator.get_context()))
        for system, port in (
            (added.hold, added.hold.get_output_port()),
            (added.filter, added.filter.GetInputPort("held_input")),
            (added.observer, added.observer.GetInputPort("input")),
        )
    )
    assert held.any()
    np.testing.assert_array_equal(seen, held)
    np.testing.assert_array_equal(observed, held)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gets_the_observer_of_its_paper(method):
    observer = guarded_blimp(method=method)[1].observer
    is_linear = isinstance(observer, LinearDisturbanceObserver)
    assert is_linear == (method == "wang-xu-dob-cbf-qp")
    assert is_linear != isinstance(observer, RiseObserver)


@pytest.mark.parametrize("method", ["dob-vcbf-qp", "wang-xu-dob-cbf-qp", "vcbf-qp"])
def test_add_safety_filter_keeps_a_users_loop_safe(method):
    diagram, _, log = guarded_blimp(method=method)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(10.0)
    assert log.FindLog(simulator.get_context()).data().min() > 0.0


def test_one_solve_a_tick_in_a_running_loop(monkeypatch):
    calls = []
    original = filter_module.choose_input

    def counting(*arguments):
        calls.append(1)
        return original(*arguments)

    monkeypatch.setattr(filter_module, "choose_input", counting)
    diagram, _, log = guarded_blimp(infeasible="stop")
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    ticks = log.FindLog(simulator.get_context()).num_samples()
    assert ticks == 51
    assert len(calls) == ticks


def test_add_safety_filter_takes_the_car_and_a_foreign_reference():
    builder = DiagramBuilder()
    car = builder.AddSystem(Car())
    pedal = builder.AddSystem(ConstantVectorSource([1.0, 0.0]))
    source = builder.AddSystem(DisturbanceSource([], num_disturbances=1))
    builder.Connect(source.get_output_port(), car.GetInputPort("disturbance"))
    wall = SphereObstacle([5.0, 0.0], 1.0, form="squared")
    AddSafetyFilter(
        builder,
        plant=car,
        reference=pedal.get_output_port(),
        barriers=[wall.barrier([4.0, 3.0])],
        input_set=InputSet.box([-4.0, -1.0], [4.0, 1.0]),
        bounds=DisturbanceBounds(0.0, 0.0, 0.0),
    )
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(20.0)
    state = car.GetOutputPort("state").Eval(
        car.GetMyContextFromRoot(simulator.get_context())
    )
    assert 3.0 < state[0] < 4.0  # Full throttle, and it stands before the wall.


def test_policy_stop_ends_a_users_simulation_at_the_infeasible_tick():
    builder = DiagramBuilder()
    car = builder.AddNamedSystem("car", Car())
    pedal = builder.AddSystem(ConstantVectorSource([0.0, 0.0]))
    source = builder.AddSystem(DisturbanceSource([], num_disturbances=1))
    builder.Connect(source.get_output_port(), car.GetInputPort("disturbance"))
    AddSafetyFilter(
        builder,
        plant=car,
        reference=pedal.get_output_port(),
        barriers=[SphereObstacle([2.0, 0.0], 1.0).barrier([10.0, 3.55])],
        input_set=InputSet.box([-1.0, -0.1], [1.0, 0.1]),
        bounds=source.bounds,
        settings=FilterSettings(infeasible="stop"),
    )
    simulator = Simulator(builder.Build())
    plant_context = car.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant_context.SetContinuousState([0.0, 0.0, 2.0, 0.0])  # Too fast to brake.
    status = simulator.AdvanceTo(5.0)
    assert "no feasible input" in status.FormatMessage()
    assert status.return_time() < 1.0


def test_a_loop_without_a_plant_needs_the_model_and_the_state():
    builder = DiagramBuilder()
    with pytest.raises(ValueError, match="then model and state must be given"):
        AddSafetyFilter(
            builder,
            plant=None,
            reference=None,
            barriers=[],
            input_set=LIMITS,
            bounds=DisturbanceBounds(0.0, 0.0, 0.0),
        )
