"""The state predicted over the link's delays, and what that buys."""

from __future__ import annotations

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
import pytest

from vcbf_drake import Blimp, Car, ControlAffineModel, load_scenario
from vcbf_drake.hil import InProcess, LinkFaults, StatePredictor

CAR = ControlAffineModel.from_system(Car())
BLIMP = ControlAffineModel.from_system(Blimp())
SLOW = {"controller_faults": LinkFaults(0.0, 0.03, 0.01, seed=1)}
SLOW |= {"vehicle_faults": LinkFaults(0.0, 0.03, 0.01, seed=2), "grid": 5}


def loop(predict: bool, duration: float, name: str = "car-avoidance", **options):
    loaded = load_scenario(name, {"hardware": {"predict": predict}})
    run = InProcess(loaded, **options)
    run.advance_to(duration)
    return run


def path(run: InProcess) -> tuple[np.ndarray, np.ndarray]:
    log = run.plant.diagram.GetSubsystemByName("log_path").FindLog(run.plant.context)
    return log.sample_times().copy(), log.data().T.copy()


# The predictor by itself -----------------------------------------------------------


def simulated(plant, x, pieces, d) -> np.ndarray:
    """The state after inputs held for some time each, by Drake's own integrator."""
    for duration, u in pieces:
        builder = DiagramBuilder()
        system = builder.AddSystem(plant)
        for port, value in (("input", u), ("disturbance", d)):
            source = builder.AddSystem(ConstantVectorSource(value))
            builder.Connect(source.get_output_port(), system.GetInputPort(port))
        simulator = Simulator(builder.Build())
        simulator.get_mutable_integrator().set_target_accuracy(1e-10)
        simulator.get_mutable_context().SetContinuousState(x)
        simulator.AdvanceTo(duration)
        x = simulator.get_context().get_continuous_state_vector().CopyToVector()
        plant = type(plant)()
    return x


def predicted(model, x, d, delays, commands, period: float = 0.02) -> np.ndarray:
    """What is predicted at the tick after so many commands, one each period."""
    predictor = StatePredictor(model, period, longest=0.1)
    context = predictor.CreateDefaultContext()
    values = {"state": x, "disturbance_estimate": d, "delays": delays}
    for name, value in values.items():
        predictor.GetInputPort(name).FixValue(context, value)
    # At a tick the hold shows the command before, for the next one is not out yet.
    for tick, command in enumerate([np.zeros_like(commands[0]), *commands]):
        predictor.GetInputPort("held_input").FixValue(context, command)
        context.SetTime(tick * period)
        found = predictor.get_output_port().Eval(context).copy()
        context.SetDiscreteState(predictor.EvalUniquePeriodicDiscreteUpdate(context))
    return found


@pytest.mark.parametrize(
    ("delays", "held_for"),
    [
        # The last two commands were sent 40 and 20 ms ago. 15 ms each way: the state
        # is from 15 ms ago, when the first of them was applied for 10 ms already.
        ((0.015, 0.015), [(-2, 0.01), (-1, 0.02)]),
        # 30 ms each way: three are on their way.
        ((0.03, 0.03), [(-3, 0.02), (-2, 0.02), (-1, 0.02)]),
        ((0.03, 0.0), [(-2, 0.01), (-1, 0.02)]),
        ((0.0, 0.01), [(-1, 0.01)]),
        ((0.0, 0.0), []),
    ],
)
@pytest.mark.parametrize("plant", [Car(), Blimp()], ids=["car", "blimp"])
def test_the_prediction_is_the_simulation_with_the_commands_on_their_way(
    plant, delays, held_for
) -> None:
    rng = np.random.default_rng(5)
    model = CAR if isinstance(plant, Car) else BLIMP
    x = rng.uniform(0.2, 0.8, model.num_states)
    d = rng.uniform(-0.2, 0.2, model.num_disturbances)
    commands = list(rng.uniform(-0.2, 0.2, (6, model.num_inputs)))
    pieces = [(duration, commands[which]) for which, duration in held_for]
    expected = simulated(type(plant)(), x, pieces, d)
    found = predicted(model, x, d, np.array(delays), commands)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)
    if sum(delays) > 0.0:
        assert np.abs(expected - x).max() > 1e-3


def test_no_longer_delay_than_the_limit_is_predicted_over() -> None:
    x, d = np.array([0.0, 0.0, 1.0, 0.0]), np.zeros(1)
    far = predicted(CAR, x, d, np.array([50.0, -3.0]), [np.zeros(2)])
    assert far[0] == pytest.approx(0.1)


# The loop --------------------------------------------------------------------------


def test_without_delays_predicting_changes_nothing() -> None:
    (_, with_it), (_, without) = (path(loop(p, 1.0)) for p in (True, False))
    assert with_it.tobytes() == without.tobytes()


def test_over_a_slow_link_the_vehicle_goes_where_it_went_without_delay() -> None:
    """30 ms each way, 10 ms jitter."""
    _, ideal = path(loop(False, 6.0))
    away = {}
    for predict in (False, True):
        run = loop(predict, 6.0, **SLOW)
        _, found = path(run)
        assert not run.plant.collided
        nearest = [np.linalg.norm(ideal[:, :2] - p[:2], axis=1).min() for p in found]
        away[predict] = np.sqrt(np.mean(np.square(nearest)))
    assert away[True] < 0.6 * away[False]


def test_the_prediction_is_where_the_vehicle_is_when_the_command_arrives() -> None:
    """Against the vehicle's true path; the observer still gets what was measured."""
    faults = LinkFaults(delay=0.03)
    loaded = load_scenario("car-avoidance", {"hardware": {"predict": True}})
    run = InProcess(loaded, faults, faults, grid=10)
    diagram = run.controller.diagram
    predictor = diagram.GetSubsystemByName("state_predictor")
    observer = diagram.GetSubsystemByName("filter_observer")
    ticks = []

    def note(context) -> None:
        mine = predictor.GetMyContextFromRoot(context)
        theirs = observer.GetMyContextFromRoot(context)
        measured = predictor.GetInputPort("state").Eval(mine)
        np.testing.assert_array_equal(
            observer.GetInputPort("state").Eval(theirs), measured
        )
        state = predictor.get_output_port().Eval(mine)
        ticks.append((context.get_time(), state.copy(), measured.copy()))

    run.controller.tick_taps.append(note)
    run.advance_to(4.0)
    times, states = path(run)
    errors = []
    for time, state, measured in ticks:
        if 2.0 < time < 3.8:
            true = [np.interp(time + 0.06, times, column) for column in states.T]
            errors.append((np.abs(state - true)[:2], np.abs(measured - true)[:2]))
    with_it, without = np.max(errors, axis=0)
    assert with_it.max() < 1e-3
    assert without.max() > 0.02


def test_a_vehicle_that_does_not_follow_is_not_predicted() -> None:
    loaded = load_scenario("car-avoidance", {"hardware": {"predict": True}})
    run = InProcess(loaded, **SLOW)
    receiver = run.controller.diagram.GetSubsystemByName("state_receiver")

    def delays() -> list[float]:
        context = receiver.GetMyContextFromRoot(run.controller.context)
        return receiver.GetOutputPort("delays").Eval(context).tolist()

    run.advance_to(0.04)
    assert delays() == [0.0, 0.0]
    run.advance_to(1.0)
    assert 0.02 <= delays()[0] <= 0.045
    assert 0.02 <= delays()[1] <= 0.045
