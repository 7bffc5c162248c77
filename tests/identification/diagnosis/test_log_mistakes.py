"""Whether a model holds: suspects that it leaves out, mistakes of a log, and the verdict."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.diagnosis.log_mistakes import find_mistake
from lgvi.identification.estimate import estimation
from lgvi.identification.estimate.wording import compare_halves
from lgvi.identification.solver.levenberg_marquardt import NotSimulatedError
from lgvi.identification.uncertainty.report_table import find_numbers

from ...systems import rng
from ..recorded import ISOTROPIC, MODEL, SIGMA_R, SIGMA_W, J

HALVES = slice(0, 3), slice(3, 6)
COUNT, TIMES = 6, np.arange(50) * 0.03
TRUTH = Model(lgvi.RigidBody(J), (lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)))
START = eqx.tree_at(lambda m: m.body, TRUTH, ISOTROPIC)


def gyroscope(model):
    return model.sensors["angular_velocity"]


def with_gyroscope(**leaves):
    return eqx.tree_at(gyroscope, TRUTH, replace(gyroscope(TRUTH), **leaves))


def with_torque(law):
    return Model(TRUTH.body, tuple(TRUTH.sensors.values()), torque=law)


def simulated(model, key):
    random = rng(210)  # the same motions, so that one program serves all
    R = Rotation.random(COUNT, rng=random).as_matrix()
    states = InitialStates(jnp.asarray(R), jnp.asarray(3 * random.normal(size=(COUNT, 3))))
    return simulate_recordings(model, TIMES, states, key=jax.random.key(key))


CAUSES = {
    "angular_velocity.bias": with_gyroscope(bias=jnp.array([0.01, 0.0, -0.005])),
    "angular_velocity.scale": with_gyroscope(scale=jnp.array([1.01, 1.0, 0.99])),
    "angular_velocity.alignment": with_gyroscope(alignment=jnp.array([0.01, 0.0, -0.01])),
    "angular_velocity.time_offset": with_gyroscope(time_offset=jnp.asarray(0.002)),
    "quadratic drag": with_torque(lgvi.QuadraticDamping(0.005 * np.trace(J) / 3 * np.eye(3))),
}


@pytest.mark.parametrize(
    "cause",
    [pytest.param(c, marks=() if c.endswith("bias") else pytest.mark.slow) for c in CAUSES],
)
def test_what_the_model_leaves_out_is_the_first_suspect(cause):
    estimate = identify(START, simulated(CAUSES[cause], 1))
    first = estimate.suspects[0]
    freeing = f"freeing {' or '.join(f'`{name}`' for name in first.names)}"
    assert cause in first.names
    assert first.is_certain
    if first.matters:
        assert estimate.verdict.startswith(f"the model does not hold: {freeing}")
    assert f"{freeing} would lower chi-square by" in " ".join(str(estimate).split())


@pytest.mark.slow
def test_a_score_test_says_what_a_fit_finds():
    """How far chi-square falls, the values, and how far the moments move."""

    def bias_of(model):
        return gyroscope(model).bias

    recorded = simulated(CAUSES["angular_velocity.bias"], 2)
    estimate = identify(START, recorded)
    freed = identify(START, recorded, free=lambda m: (m.body, bias_of(m)))
    suspect = estimate.suspects[0]
    assert suspect.gain == pytest.approx(estimate.chi_square - freed.chi_square, rel=0.01)
    found = np.asarray(bias_of(freed.model))
    np.testing.assert_allclose(suspect.values, found, atol=0.1 * SIGMA_W / np.sqrt(50))
    errors = np.asarray(bias_of(freed.standard_error(errors="correlated")))
    np.testing.assert_allclose(suspect.errors, errors, rtol=0.2)
    after, before = freed.summary(), estimate.summary()
    i = before["name"].tolist().index(suspect.moved)
    assert suspect.shift == pytest.approx(after["value"][i] - before["value"][i], rel=0.05)


def test_of_a_model_that_holds_nothing_is_suspected():
    estimate = identify(START, simulated(TRUTH, 3))
    assert estimate.verdict == "the model holds"
    assert not any(suspect.is_certain for suspect in estimate.suspects)
    assert len(estimate.suspects) > 5


def misread(recorded, attitudes=None, rates=None, times=1.0, alone=False):
    found = []
    for each in recorded:
        t, R = each["attitude"]
        values = {"attitude": R if attitudes is None else attitudes(R)}
        if not alone:
            omega = each["angular_velocity"][1]
            values["angular_velocity"] = omega if rates is None else rates(omega)
        found.append(Recordings.from_arrays(times * t, **values, name=str(len(found))))
    return Recordings.concatenate(found)


def scalar_last_as_first(R):
    return Rotation.from_quat(Rotation.from_matrix(R).as_quat(), scalar_first=True).as_matrix()


def transposed(R):
    return np.swapaxes(R, 1, 2)


def scalar_first_as_last(R):
    return Rotation.from_quat(Rotation.from_matrix(R).as_quat(scalar_first=True)).as_matrix()


MISTAKES = {
    "quaternions scalar-first": {"attitudes": scalar_first_as_last},
    "quaternions scalar-last": {"attitudes": scalar_last_as_first},
    "attitudes as space to body": {"attitudes": transposed},
    "rates as degrees per second": {"rates": np.degrees},
    "rates as revolutions per minute": {"rates": lambda omega: omega * 30 / np.pi},
    "rates as revolutions per second": {"rates": lambda omega: omega / (2 * np.pi)},
    "rates as counts of 16.4 for each degree per second": {
        "rates": lambda omega: np.round(np.degrees(omega) * 16.4)
    },
    "rates as counts of 131 for each degree per second": {
        "rates": lambda omega: np.round(np.degrees(omega) * 131)
    },
    "rates as milliradians per second or the times as milliseconds": {"times": 1e3},
    "times as microseconds": {"times": 1e6},
    "times as nanoseconds": {"times": 1e9},
    "times as minutes": {"times": 1 / 60},
    "rates as degrees per second and the times as microseconds": {
        "rates": np.degrees,
        "times": 1e6,
    },
    "rates, or the times, 7 times too large": {"rates": lambda omega: 7 * omega},
    "axes of the rates as (x, -y, z)": {"rates": lambda omega: omega * [1, -1, 1]},
    "axes of the rates as (y, z, x)": {"rates": lambda omega: omega[:, [2, 0, 1]]},
    "axes of the rates as (y, z, x) and the rates as degrees per second": {
        "rates": lambda omega: np.degrees(omega[:, [2, 0, 1]])
    },
}
TWO_AT_ONCE = {
    "quaternions scalar-last and the rates as degrees per second": {
        "attitudes": scalar_last_as_first,
        "rates": np.degrees,
    },
    "attitudes as space to body and the axes of the rates as (x, -y, z)": {
        "attitudes": transposed,
        "rates": lambda omega: omega * [1, -1, 1],
    },
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_usual_mistake_of_a_log_is_named(mistake):
    for key in range(5):
        recorded = simulated(TRUTH, key)
        assert find_mistake(TRUTH, recorded) is None
        found = find_mistake(TRUTH, misread(recorded, **MISTAKES[mistake]))
        assert found is not None
        assert found.reading == f"the {mistake}"
        assert found.better > 100
        if "attitudes" in MISTAKES[mistake]:  # attitudes alone do not tell which of two
            assert find_mistake(MODEL, misread(recorded, alone=True)) is None
            found = find_mistake(MODEL, misread(recorded, alone=True, **MISTAKES[mistake]))
            assert found is not None
            assert mistake in found.reading


@pytest.mark.parametrize("mistakes", TWO_AT_ONCE)
def test_two_mistakes_at_once_are_named(mistakes):
    for key in range(5):
        found = find_mistake(TRUTH, misread(simulated(TRUTH, key), **TWO_AT_ONCE[mistakes]))
        assert found is not None
        assert mistakes in found.reading
        assert found.better > 100


@pytest.mark.parametrize(("times", "unit"), [(1e-3, "milli"), (1e-6, "micro")])
def test_a_unit_that_the_log_does_not_have_is_named(times, unit):
    """Such as times in seconds that were read as milliseconds."""
    recorded = simulated(TRUTH, 0)
    found = find_mistake(TRUTH, misread(recorded, times=times))
    assert f"the times, taken for {unit}seconds, as seconds" in str(found)
    rates = recorded.channels["angular_velocity"]
    slow, fast, right = (
        Recordings.concatenate(
            [Recordings.from_arrays(factor * t, angular_velocity=w) for t, w in rates]
        )
        for factor in (times, 1 / times, 1.0)
    )
    found = find_mistake(Model(gyroscope(TRUTH)), slow)
    assert f"the times, taken for {unit}seconds, as seconds" in str(found)
    for other in (right, fast):  # rates that are too large are those of another body
        assert find_mistake(Model(gyroscope(TRUTH)), other) is None


@pytest.mark.parametrize("mistake", ["rates as degrees per second", "quaternions scalar-last"])
def test_a_log_that_is_certainly_mistaken_is_refused(mistake):
    recorded = misread(simulated(TRUTH, 0), **MISTAKES[mistake])
    with pytest.raises(ValueError, match=f"has a usual mistake: reading the {mistake} fits .* so;"):
        identify(START, recorded)


@pytest.mark.parametrize(("times", "unit"), [(1e3, "milli"), (1e6, "micro")])
def test_a_log_that_cannot_be_simulated_is_refused_at_once(times, unit):
    recorded = misread(simulated(TRUTH, 0), times=times)
    words = rf"^The log .*: reading .*the times as {unit}seconds fits .*'0' must turn by"
    with (
        pytest.warns(UserWarning, match=f"the times as {unit}seconds fits"),
        pytest.raises(ValueError, match=words),
    ):
        identify(START, recorded, check=False)
    rates = recorded.channels["angular_velocity"]
    alone = Recordings.from_arrays(rates.t[0], angular_velocity=rates.value[0])
    with pytest.raises(ValueError, match=r"^Trajectory '0' must turn by at most 20 rad .*`dt`\.$"):
        identify(Model(gyroscope(TRUTH)), alone)


@pytest.mark.parametrize(
    ("kind", "seen"),
    [
        (ValueError, ValueError),
        (NotSimulatedError, RuntimeError),
        (KeyboardInterrupt, KeyboardInterrupt),
    ],
)
def test_errors_of_a_fit_begin_with_the_mistake(kind, seen, monkeypatch):
    def fails(*_):
        raise kind("no step converged")

    monkeypatch.setattr(estimation, "fit", fails)
    recorded = misread(simulated(TRUTH, 0), rates=np.degrees)
    words = "reading the rates as degrees per second fits"
    with pytest.warns(UserWarning, match=words), pytest.raises(seen, match=f"^The.*{words}"):
        identify(START, recorded, check=False)


def test_the_verdict_names_the_mistake():
    recorded = misread(simulated(TRUTH, 4), attitudes=transposed)
    with pytest.warns(UserWarning, match="a usual mistake, it seems: reading the attitudes as sp"):
        estimate = identify(START, recorded, iterations=5, check=False)
    first = str(estimate).splitlines()[0]
    assert first.startswith(
        "verdict: the model does not hold: reading the attitudes as space to body fits "
    )
    assert estimate.mistakes[0].startswith("reading the attitudes as space to body fits ")


@pytest.mark.slow
def test_a_sensor_that_is_fitted_as_turned_is_no_mistake():
    """Before the fit it looks like one."""
    recorded = simulated(with_gyroscope(alignment=jnp.array([0.0, 0.0, 1.45])), 7)
    with pytest.warns(UserWarning, match=r"the axes of the rates as"):
        estimate = identify(
            START,
            recorded,
            free=lambda m: (m.body, m.sensors["angular_velocity"].alignment),
            check=False,
        )
    assert estimate.mistakes == ()
    assert estimate.verdict == "the model holds"


@pytest.mark.slow
def test_halves_are_as_far_apart_as_fits_to_each():
    """In standard errors of the difference, which are those of independent halves.

    Both are of the same motions, so that they tell as much.
    """
    halves: Any = [list(simulated(TRUTH, key))[HALVES[0]] for key in (5, 6)]
    recorded = Recordings.concatenate(
        [
            Recordings.from_arrays(**each, name=f"{half}, {i}")
            for half, trajectories in enumerate(halves)
            for i, each in enumerate(trajectories)
        ]
    )
    whole = identify(START, recorded)
    first, second = (identify(START, recorded.select(recorded.names[at])) for at in HALVES)
    numbers = find_numbers(whole)
    apart, chance = compare_halves(whole.correlated, numbers.jacobian)
    shown = np.array(["moment" in name for name in numbers.names])
    difference = (find_numbers(first).values - find_numbers(second).values)[shown]
    error = 2 * whole.summary()["standard_error"][shown]  # of a difference of halves
    np.testing.assert_allclose(apart[shown], difference / error, atol=0.1)
    assert np.min(chance) > 1e-3
    assert "halves of the data against each other: at most" in str(whole)


def test_a_trajectory_whose_noise_is_larger_is_seen():
    recorded = simulated(TRUTH, 6)
    louder = [
        Recordings.from_arrays(
            each["attitude"][0],
            attitude=each["attitude"][1],
            angular_velocity=each["angular_velocity"][1]
            + (i == 2) * SIGMA_W * rng(211).normal(size=(len(TIMES), 3)),
            name=str(i),
        )
        for i, each in enumerate(recorded)
    ]
    estimate = identify(START, Recordings.concatenate(louder))
    assert "residuals differ in size" in estimate.verdict
    assert estimate.verdict.startswith("the model holds with the intervals given")
    independent = identify(START, Recordings.concatenate(louder), errors="independent")
    assert independent.verdict.startswith("the model may hold, but independent errors do not")
    assert "(`2`)" in str(estimate)
