"""The experiment that tells most: its gradient, its limits, and what it promises."""

import csv
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import (
    InitialStates,
    Limits,
    Model,
    Motors,
    Recordings,
    Torques,
    Wheels,
    identifiability,
    plan,
    simulate_recordings,
)
from lgvi.identification.model.free_leaves import linearise_quantity
from lgvi.identification.model.selection import select_free_leaves
from lgvi.identification.planning.criterion import POWERS, assess
from lgvi.identification.planning.manoeuvre import Experiment, Grid
from lgvi.identification.planning.search import Goal, Space, find_directions
from lgvi.identification.running import compilation

from ...systems import euler_equations, rng

ANY: Any = lambda value: value  # noqa: E731 - of no type
MOMENTS = np.array([2.1e-3, 3.0e-3, 4.2e-3])  # kg m²
BODY = lgvi.PhysicalRigidBody.from_principal_moments(MOMENTS)
CAMERA = lgvi.AttitudeSensor(sigma=1e-3)
THROWN = Model(BODY, CAMERA)
T = np.arange(30) * 0.025  # s
LIMITS = Limits(rate=6.0, trajectories=2)
DURATION = 20.0  # s, of the spacecraft
SPINS = np.array([2e-4, 3e-4, 2e-4])  # kg m²
WHEELS = Wheels(
    np.array([[1, 0, 0], [0, 2, 0], [1, 1, 1]]), SPINS, 300.0, 60.0, torque=0.02, knots=4
)
CRAFT = Model(
    lgvi.PhysicalRigidBody.from_principal_moments([0.11, 0.16, 0.19]),
    lgvi.Gyroscope(2e-4, bias=np.array([1e-3, -2e-3, 0.5e-3])),
    torque=lgvi.ConstantTorque(np.array([1e-4, 0.0, -1e-4])),
)
CRAFT_TIMES = np.linspace(0, DURATION, 201)
CRAFT_LIMITS = Limits(
    rate=1.0, initial_rate=0.2, saturation=np.array([0.6, 0.7, 0.8]), commands=WHEELS
)


def free_of_craft(model):
    return model.body, model.sensors["angular_velocity"].bias


def ratios(model):
    J = model.body.inertia
    return jnp.linalg.eigvalsh(J) / jnp.trace(J)


def moments(model):
    return jnp.linalg.eigvalsh(model.body.inertia)


def space_of(model, times, limits, free):
    """All experiments with a model, and its free leaves."""
    commands = None if limits.commands is None else limits.commands.of(model)
    selected = select_free_leaves(model, free, ())
    (channel,) = model.sensors
    grid = Grid.of({channel: times}, 2.0 * limits.rate, commands)
    count, p = limits.trajectories, len(selected.theta)
    experiment = Experiment.of(model, selected.selected, None, grid, commands, limits)
    return selected, Space(
        experiment,
        limits,
        selected.theta[None],
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 0)),
        np.zeros((1, p, p)),
    )


@pytest.fixture(scope="module")
def throws():
    return space_of(THROWN, T, LIMITS, lambda model: model.body)


@pytest.fixture(scope="module")
def craft():
    return space_of(CRAFT, CRAFT_TIMES, CRAFT_LIMITS, free_of_craft)


@pytest.fixture(scope="module")
def planned():
    return plan(THROWN, T, LIMITS, criterion="E", quantity=ratios)


@pytest.fixture(scope="module")
def planned_craft():
    options = {"free": free_of_craft, "criterion": "A", "quantity": moments}
    return plan(CRAFT, CRAFT_TIMES, CRAFT_LIMITS, **options)


@pytest.mark.parametrize("criterion", POWERS)
@pytest.mark.parametrize("rows", [3, 4])
def test_criteria_are_those_of_the_covariance_and_their_derivative(criterion, rows):
    random = rng(180)
    root, jacobian = random.normal(size=(9, 5)), random.normal(size=(3, 5))
    if rows == 4:  # which depends on the others
        jacobian = np.concatenate([jacobian, -jacobian.sum(0, keepdims=True)])

    def value(information):
        C = jacobian @ np.linalg.inv(information) @ jacobian.T
        variances = np.linalg.eigvalsh(C)[-3:]
        sizes = {"D": np.prod(variances) ** (1 / 3), "A": np.mean(variances)}
        size = sizes.get(criterion, np.mean(variances**16) ** (1 / 16))
        return np.log(size) / 2

    information = root.T @ root
    found, slope = assess(criterion, information, jacobian)
    np.testing.assert_allclose(found, value(information), rtol=1e-9)
    change = random.normal(size=(5, 5))
    change = 1e-5 * (change + change.T)
    difference = (value(information + change) - value(information - change)) / 2
    np.testing.assert_allclose(np.sum(slope * change), difference, rtol=1e-6)


def test_the_search_sees_the_information_of_the_integrator(throws, craft):
    # Runge and Kutta's steps with eliminated states, against segments of the integrator and a QR.
    _, space = throws
    omega = rng(181).normal(size=(2, 3)) * 2
    seen = space.evaluate(omega).information[0]
    told = identifiability(THROWN, T, InitialStates.from_rates(omega))
    expected = np.sort(told.singular_values)[1:]
    np.testing.assert_allclose(np.sqrt(np.linalg.eigvalsh(seen)[1:]), expected, rtol=0.01)
    _, space = craft
    manoeuvre = space.draw(rng(182))
    seen = space.evaluate(manoeuvre).information[0]
    knots = np.linspace(0, DURATION, 4)
    layout = Recordings.from_arrays(
        angular_velocity=(CRAFT_TIMES, np.zeros((201, 3))),
        rotor_momentum=(knots, manoeuvre[0, 3:].reshape(4, 3) @ WHEELS.of(CRAFT).momentum),
    )
    states = InitialStates.from_rates(manoeuvre[:, :3])
    told = identifiability(CRAFT, layout, states, free=free_of_craft)
    errors = np.sqrt(np.diag(np.linalg.inv(seen)))
    # Of many readings each node of the search stands for some.
    np.testing.assert_allclose(errors, np.sqrt(np.diag(told.covariance())), rtol=0.03)


@pytest.mark.parametrize("which", ["throws", "craft"])
def test_gradients_of_the_criterion_and_the_limits_are_those_of_differences(which, request):
    (selected, space), random = request.getfixturevalue(which), rng(183)
    manoeuvres = 0.5 * space.draw(random)
    quantity = ratios if which == "throws" else moments
    model = space.experiment.model
    _, jacobian = linearise_quantity(quantity, model, selected, selected.theta[None])
    goal = Goal("A", jacobian, find_directions([space.evaluate(space.draw(random))]).seen)
    here = space.evaluate(manoeuvres)
    _, gradient = goal.assess(here)
    change = 1e-5 * space.scale * random.normal(size=manoeuvres.shape)
    after, before = (space.evaluate(manoeuvres + s * change) for s in (1, -1))
    difference = (goal.assess(after)[0] - goal.assess(before)[0]) / 2
    np.testing.assert_allclose(np.sum(gradient * change), difference, rtol=1e-5)
    for name, slope in here.effects.uses_changes.items():
        difference = (after.effects.uses[name] - before.effects.uses[name]) / 2
        along = np.einsum("tkn,tn->tk", slope, change)
        np.testing.assert_allclose(along, difference, atol=1e-6 * np.max(abs(difference)))


def test_a_planned_throw_is_within_its_limits_and_better_than_others(planned):
    omega = np.asarray(planned.states.omega)
    for start in omega:
        _, pi = euler_equations(np.eye(3), MOMENTS * start, np.diag(MOMENTS), T)
        fastest = np.max(np.linalg.norm(pi / MOMENTS, axis=1))
        assert 0.99 * 6.0 < fastest <= 6.0  # the limit binds
    (use,) = planned.uses
    assert use.name == "rate"
    assert use.binds
    assert planned.converged
    told = identifiability(THROWN, T, planned.states)
    np.testing.assert_allclose(
        planned.standard_error(ratios), told.standard_error(ratios), rtol=1e-6
    )
    random = rng(184)
    for _ in range(10):
        directions = random.normal(size=(2, 3))
        sizes = np.linalg.norm(directions, axis=1, keepdims=True)
        other = identifiability(THROWN, T, InitialStates.from_rates(5.0 * directions / sizes))
        assert np.max(other.standard_error(ratios)) > 1.3 * np.max(planned.standard_error(ratios))
    assert np.max(planned.usual.standard_error(ratios)) > 2 * np.max(planned.standard_error(ratios))


def test_more_throws_reach_a_wanted_error(planned):
    error = np.max(planned.standard_error(ratios))
    assert planned.count_trajectories(ratios, 1.01 * error) == 2
    count = planned.count_trajectories(ratios, error / 3)
    assert count in (18, 20)  # nine times the plan, but for what the search rounds
    again = InitialStates.from_rates(np.tile(planned.states.omega, (count // 2, 1)))
    told = identifiability(THROWN, T, again)
    assert np.max(told.standard_error(ratios)) <= 1.001 * error / 3
    with pytest.raises(ValueError, match="must be observable"):
        planned.count_trajectories(moments, 1e-4)
    with pytest.raises(ValueError, match="`error` must be above 0, but is 0"):
        planned.count_trajectories(ratios, 0)


def test_commands_are_within_what_the_wheels_can_do(planned_craft, tmp_path):
    values = np.stack([*planned_craft.commands.values()], axis=-1)[0]
    assert list(planned_craft.commands) == ["wheel 0", "wheel 1", "wheel 2"]
    assert np.all(abs(values) <= 300 * (1 + 1e-9))
    slopes = np.diff(values, axis=0) / np.diff(planned_craft.knots)[:, None]
    assert np.all(abs(slopes) <= 60 * (1 + 1e-6))
    readings = planned_craft.recordings.channels["angular_velocity"].value
    assert np.all(abs(readings) <= [0.6, 0.7, 0.8])
    rates = readings[0] - 1e-3 * np.array([1, -2, 0.5])
    assert np.linalg.norm(planned_craft.states.omega) <= 0.2 * (1 + 1e-9)
    at = np.stack([np.interp(CRAFT_TIMES, planned_craft.knots, x) for x in values.T], axis=1)
    spins = at * SPINS + rates @ WHEELS.of(CRAFT).momentum.T
    assert np.max(abs(np.diff(spins, axis=0)) / np.diff(CRAFT_TIMES)[:, None]) <= 0.02 * 1.01
    ((_, momentum),) = planned_craft.recordings.rotor_momentum
    np.testing.assert_allclose(momentum, values @ WHEELS.of(CRAFT).momentum, atol=1e-12)
    fine = np.linspace(0, DURATION, 4001)
    layout = Recordings.from_arrays(
        angular_velocity=(fine, np.zeros((len(fine), 3))),
        rotor_momentum=(planned_craft.knots, momentum),
    )
    moved = simulate_recordings(CRAFT, layout, planned_craft.states)
    ((_, fast),) = moved.channels["angular_velocity"]
    assert np.all(abs(fast) <= [0.6, 0.7, 0.8])
    assert np.max(abs(fast) / [0.6, 0.7, 0.8]) > 0.99  # the limit binds
    assert np.max(np.linalg.norm(fast - 1e-3 * np.array([1, -2, 0.5]), axis=1)) <= 1.0
    file = tmp_path / "wheels.csv"
    planned_craft.to_csv(file, rate=2.0)
    with open(file, encoding="utf-8") as opened:
        header, *rows = csv.reader(opened)
    assert header[0] == "trajectory"
    assert header[4:] == ["t (s)", *(f"wheel {k} (rad/s)" for k in range(3))]
    table = np.array(rows, float)
    np.testing.assert_allclose(table[:, 4], np.arange(41) / 2)
    np.testing.assert_allclose(
        table[:, 6], np.interp(table[:, 4], planned_craft.knots, values[:, 1])
    )
    np.testing.assert_allclose(table[:, 1:4], np.tile(planned_craft.states.omega, (41, 1)))


def test_words_say_what_to_do_and_what_binds(planned, planned_craft, tmp_path):
    text = str(planned)
    assert "limit: rate 5.98" in text
    assert "which binds" in text
    for start in np.asarray(planned.states.omega):
        assert ", ".join(f"{rate:.4g}" for rate in start) in text
    assert "trajectory 0, wheel 2: " in str(planned_craft)
    assert "limits that do not bind: " in str(planned_craft)
    summary = planned.summary()
    np.testing.assert_allclose(summary["standard_error"][:3], planned.standard_error(ratios))
    assert list(summary["name"][:4]) == [f"quantity[{k}]" for k in range(3)] + [
        "trace of the inertia"
    ]
    assert np.isinf(summary["standard_error"][3])
    assert np.all(summary["usual"][-3:] > 2 * summary["standard_error"][-3:])  # of the moments
    planned.to_csv(tmp_path / "throws.csv")
    with open(tmp_path / "throws.csv", encoding="utf-8") as opened:
        rows = [*csv.reader(opened)]
    assert rows[0] == ["trajectory", *(f"angular_velocity_{axis} (rad/s)" for axis in "xyz")]
    np.testing.assert_array_equal(np.array(rows[1:], float)[:, 1:], planned.states.omega)


def test_what_is_known_counts_as_readings_do(planned):
    # The information of two experiments is that of both, whichever is known first.
    first = InitialStates.from_rates([[1.0, 4.0, 0.5]])
    both = InitialStates.from_rates(np.concatenate([planned.states.omega, first.omega]))
    known = identifiability(THROWN, T, first).as_prior()
    told = identifiability(THROWN, T, planned.states, prior=known)
    expected = identifiability(THROWN, T, both)
    np.testing.assert_allclose(
        told.standard_error(ratios), expected.standard_error(ratios), rtol=1e-6
    )
    after = plan(THROWN, T, LIMITS, criterion="E", quantity=ratios, prior=known, draws=0)
    assert np.max(after.standard_error(ratios)) < np.max(planned.standard_error(ratios))
    assert np.max(after.standard_error(ratios)) <= 1.01 * np.max(told.standard_error(ratios))
    error = np.max(after.standard_error(ratios))
    assert after.count_trajectories(ratios, error / 3) > 18  # what is known is not done again


def test_what_is_known_does_not_depend_on_a_scale_that_is_not():
    # Coefficients of rotors are known over the trace of the inertia, which was made one.
    arms = 0.09 * np.array([[1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0]])
    rotors = lgvi.Multirotor(
        arms, np.array([0, 0, 1.0]), 2.5e-6, 4e-8, lag=None, spin=[1, 1, -1, -1], inertia=1e-5
    )
    model = Model(BODY, lgvi.Gyroscope(0.01), rotors=rotors)

    def told(model, seeds, prior=()):
        t, layouts = np.arange(60) * 0.02, []
        for seed in seeds:
            speeds = rng(seed).uniform(600, 900, (6, 4))
            layouts.append(
                Recordings.from_arrays(
                    angular_velocity=(t, np.zeros((60, 3))),
                    rotor_speed=(np.linspace(0, t[-1], 6), speeds),
                    name=str(seed),
                )
            )
        states = InitialStates.from_rates(np.zeros((len(seeds), 3)))
        free = lambda m: (m.body, m.rotors.thrust, m.rotors.drag, m.rotors.inertia)  # noqa: E731
        layout = Recordings.concatenate(layouts)
        return identifiability(model, layout, states, free=free, prior=prior)

    def over_trace(model):
        return model.rotors.thrust / jnp.trace(model.body.inertia)

    first, both = told(model, [186]), told(model, [186, 187])
    for start in (model, first.model):
        second = told(start, [187], first.as_prior())
        np.testing.assert_allclose(
            second.standard_error(over_trace), both.standard_error(over_trace), rtol=1e-6
        )


def test_an_estimate_as_a_prior_has_its_errors(estimate):
    independent = estimate.with_errors("independent")
    ((known, mean, deviation),) = independent.as_prior()
    np.testing.assert_allclose(known(independent.model), mean, rtol=1e-9)
    covariance = independent.covariance(known)
    np.testing.assert_allclose(covariance, deviation * np.eye(5), atol=1e-6)
    with pytest.raises(ValueError, match="must be of more trajectories than 5"):
        estimate.with_errors("clustered").as_prior()
    with pytest.raises(TypeError, match=r"is of type Estimate: give its `as_prior\(\)`"):
        identifiability(THROWN, T, InitialStates.from_rates([1.0, 2, 3]), prior=estimate)


def test_with_a_prior_the_limits_hold_for_all_its_draws():
    def sides(model):
        return jnp.log(jnp.diagonal(model.body.inertia))

    prior = [(sides, np.log(MOMENTS), 0.2)]
    wide = plan(THROWN, T, LIMITS, prior=prior, draws=6)
    alone = plan(THROWN, T, LIMITS, prior=prior, draws=0)

    def fastest(planned):
        """The largest rate for bodies of the prior."""
        largest = []
        for factors in np.exp(0.15 * rng(185).normal(size=(20, 3))):
            for start in np.asarray(planned.states.omega):
                J = MOMENTS * factors
                _, pi = euler_equations(np.eye(3), J * start, np.diag(J), T)
                largest.append(np.max(np.linalg.norm(pi / J, axis=1)))
        return np.quantile(largest, 0.9)

    assert fastest(wide) < fastest(alone)
    assert wide.uses[0].extreme <= 6.0
    # No throw shows the size of the inertia, which is known by the prior alone.
    with pytest.raises(ValueError, match=r"`error` must be above .* what is known before"):
        alone.count_trajectories(moments, 1e-5)


def test_commands_keep_their_slope_where_the_calm_is_beyond_a_limit():
    pushed = Model(
        lgvi.PhysicalRigidBody.from_principal_moments([1.1, 1.6, 1.9]),
        CAMERA,
        torque=lgvi.ConstantTorque(np.array([0.3, -0.2, 0.25])),
    )
    torques = Torques(1.0, slope=0.15, start=0.0, knots=4)
    limits = Limits(rate=2.0, turn=1.3, commands=torques)
    held = plan(pushed, np.linspace(0, 5, 21), limits)
    assert all(use.is_kept for use in held.uses)
    values = np.stack([*held.commands.values()], axis=-1)[0]
    slopes = np.diff(values, axis=0) / np.diff(held.knots)[:, None]
    assert np.max(abs(slopes)) <= 0.15 * (1 + 1e-6)


def test_motors_torques_and_attitudes_at_the_start():
    arms = 0.09 * np.array([[1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0]])
    rotors = lgvi.Multirotor(
        arms, np.array([0, 0, 1.0]), 2.5e-6, 4e-8, lag=None, spin=[1, 1, -1, -1], inertia=1e-5
    )
    model = Model(BODY, lgvi.Gyroscope(0.01), rotors=rotors)
    motors = Motors(500.0, 1000.0, np.full(4, 2000.0), start=np.full(4, 767.0), knots=3)
    limits = Limits(rate=3.0, turn=0.5, commands=motors)
    R0 = np.array(lgvi.so3.exp(jnp.array([0.0, 0.0, 1.0])))
    flown = plan(model, np.arange(30) * 0.02, limits, R0=R0, criterion="E", quantity=moments)
    values = np.stack([*flown.commands.values()], axis=-1)[0]
    np.testing.assert_allclose(values[0], 767.0)
    assert np.all((values >= 500 * (1 - 1e-9)) & (values <= 1000 * (1 + 1e-9)))
    np.testing.assert_allclose(flown.states.R[0], R0)
    assert np.all(np.asarray(flown.states.omega) == 0)
    uses = {use.name: use for use in flown.uses}
    assert uses["turn"].extreme <= 0.5
    assert {"lowest of motor 3", "highest of motor 0", "change of motor 1"} <= set(uses)
    np.testing.assert_allclose(uses["lowest of motor 3"].extreme, values[:, 3].min())
    errors, usual = (np.max(x.standard_error(moments)) for x in (flown, flown.usual))
    assert errors < usual / 4


def test_a_thrown_body_falls():
    falling = Model(BODY, CAMERA, gravity=np.array([0, 0, -9.81]))
    fallen = 9.81 / 2 * T[-1] ** 2
    with pytest.raises(ValueError, match=f"`travel` comes down to {fallen:.3g} m, and its limit"):
        plan(falling, T, Limits(rate=6.0, travel=0.9 * fallen))


def test_limits_that_no_experiment_keeps_are_named():
    acceleration = 0.02 / MOMENTS[2]
    pushed = Model(BODY, CAMERA, torque=lgvi.ConstantTorque(np.array([0, 0, 0.02])))
    # Thrown against the torque, the body turns back and forth; as far in both directions at best.
    least = acceleration / 2 * ((2**0.5 - 1) * T[-1]) ** 2
    words = r"none was found: `turn` comes down to (0\.\d+) rad, and its limit is 0.15 rad"
    with pytest.raises(ValueError, match=words) as raised:
        plan(pushed, T, Limits(rate=6.0, turn=0.15))
    reached = re.search(words, str(raised.value))
    assert reached is not None
    assert least * 0.999 < float(reached[1]) < 1.2 * least
    kept = plan(pushed, T, Limits(rate=6.0, turn=1.2 * least))
    omega = float(kept.states.omega[0, 2])
    assert abs(omega * T[-1] + acceleration / 2 * T[-1] ** 2) < 1.2 * least
    assert omega**2 / 2 / acceleration < 1.2 * least


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"rate": 0.0}, "`rate` must be above 0, but is 0.0"),
        ({"trajectories": 0}, "`trajectories` must be a whole number above 0, but is 0"),
        ({"initial_rate": 7.0}, "`initial_rate` must be a number from 0 to `rate`"),
        ({"trajectories": True}, "`trajectories` must be a whole number above 0, but is True"),
        ({"turn": [1.0]}, r"`turn` must be a number, but is \[1.0\]"),
        ({"turn": 4.0}, "`turn` must be at most pi rad, as no turn is larger, but is 4.0"),
        ({"saturation": [1.0, 2.0]}, r"`saturation` must be a number or have shape \(3,\)"),
    ],
)
def test_limits_must_be_possible(arguments, words, unchecked):
    with pytest.raises(ValueError, match=words):
        Limits(**({"rate": 6.0} | arguments))


def test_hardware_must_be_possible(unchecked):
    with pytest.raises(ValueError, match="`axes` must have a direction for each wheel"):
        Wheels(np.array([0, 0, 1]), 1e-4, 100.0)
    with pytest.raises(ValueError, match="`speed` must be above 0, but is -1"):
        Wheels(np.array([[0, 0, 1]]), 1e-4, -1)
    with pytest.raises(ValueError, match="`start` must be within the limits"):
        Wheels(np.array([[0, 0, 1]]), 1e-4, 100.0, start=200.0)
    with pytest.raises(ValueError, match="`lowest` must be below `highest`"):
        Motors(3.0, 3.0)
    with pytest.raises(ValueError, match="`knots` must be a whole number above 1, but is 1"):
        Torques(0.1, knots=1)
    with pytest.raises(TypeError, match="`torque` must be numbers, but is 'much'"):
        Torques(ANY("much"))
    with pytest.raises(TypeError, match="`commands` must be `Wheels`, `Motors`, `Torques` or"):
        Limits(1.0, commands=ANY(3.0))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"criterion": "E"}, '`quantity` must be a function of the model for the criterion "E"'),
        ({"criterion": "Z"}, '`criterion` must be "D", "A" or "E", but is \'Z\''),
        (
            {"limits": Limits(400.0)},
            "must not let the body turn by more than 3.14 rad from reading",
        ),
        ({"draws": -1}, "`draws` must be a whole number from 0 on, but is -1"),
        ({"times": {"attitudes": T}}, "`times` must have the channels attitude, but has attitudes"),
        ({"times": T[:1]}, "`times` must have two times at least"),
        ({"R0": np.zeros((2, 2))}, r"`R0` must have shape \(3, 3\) or \(2, 3, 3\)"),
        ({"R0": np.zeros((3, 3))}, "`R0` must have rotation matrices"),
        ({"limits": Limits(6.0, saturation=5.0)}, "`saturation` of the limits must be None where"),
        ({"limits": Limits(6.0, travel=5.0)}, "`travel` of the limits must be None where"),
        ({"limits": Limits(6.0, commands=Motors(0.0, 1.0))}, "`model` must have `rotors` where"),
        ({"limits": Limits(6.0, initial_rate=0.0)}, "`limits` must allow an experiment that shows"),
        ({"quantity": moments}, "`quantity` must be what an experiment within the limits can show"),
        (
            {"quantity": lambda model: model.sensors["attitude"].alignment},
            "`quantity` must depend on what is free",
        ),
    ],
)
def test_a_plan_of_wrong_arguments(options, words, unchecked):
    arguments = {"model": THROWN, "times": T, "limits": LIMITS} | options
    with pytest.raises(ValueError, match=words):
        plan(**arguments)


def test_a_free_clock_is_refused():
    late = Model(BODY, [CAMERA, lgvi.Gyroscope(0.01, time_offset=0.0)])
    with pytest.raises(ValueError, match="`free` must not choose `angular_velocity"):
        plan(late, T, LIMITS, free=lambda m: (m.body, m.sensors["angular_velocity"].time_offset))


def test_a_second_plan_compiles_nothing(planned, monkeypatch):
    programs = []
    monkeypatch.setattr(compilation, "say_compiling", programs.append)
    again = plan(THROWN, T, Limits(rate=5.0, trajectories=2), criterion="E", quantity=ratios)
    assert not programs
    assert np.max(again.standard_error(ratios)) > np.max(planned.standard_error(ratios))
