"""Experiments of every kind, from simulated recordings to the inertia that made them.

True motions are those of SciPy, but for the chaotic one. It takes some minutes:
python -m pytest -n 0 -q -o python_files="proof_*.py" tests/benchmarks
"""

from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import InitialStates, Model, identify, simulate_recordings

from ..identification.recorded import errors_of, moments, ratios
from ..systems import inertia, rng, rotation
from .tosses import directions, motions, recorded, text

ISOTROPIC = lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3))
REPETITIONS = 20


def drag_ratios(model):
    return model.torque.matrix / jnp.trace(model.body.inertia)


def test_a_tennis_racket_in_air(line):
    """Moment ratios near the unstable axis, with the coefficients of its drag free."""
    truth, drag, random = np.array([0.11, 0.42, 0.47]), np.array([2e-3, 9e-3, 7e-3]), rng(203)
    axes = rotation(203)
    J, t = inertia(truth, axes), np.arange(200) * 0.01

    def torque(omega):
        return -np.linalg.norm(omega, axis=1, keepdims=True) * drag * omega

    omega0 = 8 * np.array([0, 1, 0]) @ axes.T + 0.3 * random.normal(size=(4, 3))
    R, omega = motions(J, omega0, t, torque)
    flips = np.einsum("nki,i->nk", omega, axes[:, 1])
    assert np.all(flips.min(1) < -4)  # it turns over
    start, found, of_drag, sizes = perf_counter(), [], [], []
    for _ in range(REPETITIONS):
        estimate = identify(
            Model(
                ISOTROPIC, lgvi.AttitudeSensor(2e-3), torque=lgvi.QuadraticDamping(np.full(3, 1e-3))
            ),
            recorded(t, R, omega, random, 2e-3),
            free=lambda model: (model.body, model.torque),
        )
        assert estimate.converged
        assert estimate.messages == ()
        assert estimate.step_bias < 0.1
        found.append(errors_of(estimate, ratios, truth / truth.sum()))
        of_drag.append(errors_of(estimate, drag_ratios, drag / truth.sum()))
        sizes.append(estimate.standard_error(ratios))
    seconds = (perf_counter() - start) / REPETITIONS
    errors = np.concatenate([found, of_drag], axis=1)
    mean, spread = np.mean(errors, axis=0), np.sqrt(np.mean(errors**2, axis=0))
    line(
        f"{'tennis racket with drag':42} {REPETITIONS} repetitions: errors of moments and drag, "
        f"mean {text(mean)}, root mean square {text(spread)} standard errors, of "
        f"{text(np.mean(sizes, axis=0), '.1e')}; {seconds:.0f} s each"
    )
    assert np.all(np.abs(mean) < 4 / np.sqrt(REPETITIONS))
    assert np.all(spread < 1 + 4 / np.sqrt(2 * REPETITIONS))


def test_a_rotor_shows_the_absolute_inertia(line):
    """From gyroscope and rotor speed alone, in throws of half a second; without it not."""
    truth, bias, random = np.array([8e-4, 1.1e-3, 1.6e-3]), np.array([0.02, -0.03, 0.01]), rng(204)
    J, t, axis = inertia(truth, rotation(204)), np.arange(250) / 500, np.array([0.0, 0.6, 0.8])

    def speed(t):
        return np.multiply.outer(900 * np.exp(-0.8 * t), axis)  # it coasts down

    omega0 = random.uniform(4, 10, (15, 1)) * directions(random, 15)
    found = []
    for momentum, given in (
        (lambda t: 4e-6 * speed(t), {"rotor_momentum": speed(t)}),
        (None, {}),
    ):
        R, omega = motions(J, omega0, t, rotor=momentum)
        start = perf_counter()
        estimate = identify(
            Model(ISOTROPIC, lgvi.Gyroscope(3e-3), rotor_inertia=4e-6),
            recorded(t, R, omega + bias, random, sigma_omega=3e-3, **given),
            free=lambda model: (model.body, model.sensors["angular_velocity"].bias),
        )
        found.append((estimate, perf_counter() - start))
    (known, seconds), (unknown, more) = found
    errors, sizes = errors_of(known, moments, truth), known.standard_error(moments)
    line(
        f"{'rotor':42} errors {text(errors)} of {text(sizes / truth, '.0e')} of the moments; bias "
        f"by the step {known.step_bias:.1g}; {seconds:.0f} s, and {more:.0f} s without the rotor"
    )
    assert known.converged
    assert known.unobservable == ()
    assert np.all(np.abs(errors) < 2)
    assert unknown.converged
    assert unknown.unobservable[0].startswith("overall scale of the inertia")
    assert np.all(np.isinf(unknown.standard_error(moments)))


def test_many_short_tosses(line):
    """391 free flights of a cube, of 0.1 s: its moments within two standard errors."""
    truth, random = np.array([0.957, 1.014, 1.029]) / 3, rng(205)
    J, t, lengths = inertia(truth, rotation(205)), np.arange(30) / 148, random.integers(8, 31, 391)
    omega0 = random.uniform(2, 6, (391, 1)) * directions(random, 391)
    given = recorded(t, *motions(J, omega0, t), random, 4.2e-4, lengths=lengths)
    start = perf_counter()
    estimate = identify(Model(ISOTROPIC, lgvi.AttitudeSensor(4.2e-4)), given)
    seconds = perf_counter() - start
    errors, sizes = errors_of(estimate, ratios, truth), estimate.standard_error(ratios)
    line(
        f"{'391 tosses':42} {seconds:.0f} s with compilation; errors {text(errors)} of "
        f"{text(sizes, '.1e')}"
    )
    assert estimate.converged
    assert estimate.messages == ()
    assert np.all(np.abs(errors) < 2)


def test_a_chaotic_pendulum_needs_segments(line):
    """Two motions that differ by 1e-6 rad/s have nothing in common after 30 s of the 60."""
    truth, centre = np.array([1.0, 2.0, 2.5]), jnp.array([0.1, 0.2, 1.0])
    body = lgvi.PhysicalRigidBody.from_inertia(inertia(truth, rotation(0)))
    law = lgvi.UniformGravity(5.0, centre, 1.0)
    t, sensor = np.arange(601) * 0.1, lgvi.AttitudeSensor(1e-3)
    omega = jnp.array([1.0, -0.6, 0.4])
    states = InitialStates(
        jnp.stack([jnp.asarray(rotation(301))] * 2), jnp.stack([omega, omega + 1e-6])
    )
    attitude = simulate_recordings(Model(body, sensor, torque=law), t, states).channels["attitude"]
    assert attitude is not None
    first, second = attitude.value
    assert np.max(np.linalg.norm(first - second, axis=(1, 2))[300:]) > 1

    alone = states.at(np.array([0]))
    given = simulate_recordings(Model(body, sensor, torque=law), t, alone, key=jax.random.key(206))
    found = []
    for segment in (5.0, None):
        start = perf_counter()
        estimate = identify(
            Model(ISOTROPIC, sensor, torque=law), given, segment=segment, iterations=20
        )
        found.append((estimate, perf_counter() - start))
    (cut, seconds), (whole, more) = found
    errors, sizes = errors_of(cut, moments, truth), cut.standard_error(moments)
    line(
        f"{'chaotic pendulum, segments':42} errors {text(errors)} of {text(sizes, '.0e')}; "
        f"{seconds:.0f} s, {cut.iterations} iterations; whole: converged {whole.converged} after "
        f"{more:.0f} s, chi-square for each {whole.chi_square / whole.degrees_of_freedom:.2g}"
    )
    assert cut.converged
    assert np.all(np.abs(errors) < 3)
    assert not whole.converged
