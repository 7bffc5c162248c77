"""Intervals contain the truth as often as they say, and bad starts end in the same minimum.

True motions are those of Euler's equations, from SciPy, but for the long recordings. This takes
an hour: python -m pytest -n 0 -q -o python_files="proof_*.py" tests/benchmarks
"""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, identify

from ..identification.recorded import errors_of, ratios
from ..systems import inertia, physical_inertias, rng, rotation
from .tosses import directions, motions, recorded, text

REPETITIONS, PAIRS = 200, 20
ISOTROPIC = lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3))


@pytest.mark.parametrize("size", [1e-3, 1e-2])
@pytest.mark.parametrize("kind", ["attitudes", "rates", "both"])
def test_intervals_contain_the_truth_as_often_as_they_say(line, kind, size):
    """95 % intervals of moments over the trace, and their bias, at 0.03 to 0.2 rad a sample.

    Errors from opposite noise cancel in their first order, so that their mean shows the bias.
    """
    truth, interval = np.array([1.0, 1.6, 2.2]) / 4.8, 0.05
    J, t = inertia(truth, rotation(201)), np.arange(50) * interval
    omega0 = np.linspace(0.03, 0.195, 8)[:, None] / interval * directions(rng(201), 8)
    R, omega = motions(J, omega0, t)
    assert 0.19 < interval * np.max(np.linalg.norm(omega, axis=2)) < 0.2
    kinds, sensors = [], []
    if kind != "rates":
        kinds.append("sigma_R")
        sensors.append(lgvi.AttitudeSensor(size))
    if kind != "attitudes":
        kinds.append("sigma_omega")
        sensors.append(lgvi.Gyroscope(size))
    body = lgvi.PhysicalRigidBody.from_inertia(J)

    def estimated(repetition, sign):
        random = rng(206, round(1e3 * size), repetition)
        given = recorded(t, R, omega, random, **dict.fromkeys(kinds, sign * size))
        estimate = identify(Model(body, sensors), given)
        assert estimate.converged
        return estimate

    found = [estimated(i, 1) for i in range(REPETITIONS)]

    def share(errors=None):
        ends = np.array([each.interval(ratios, errors) for each in found])
        return np.mean((ends[:, 0] < truth) & (truth < ends[:, 1]), axis=0)

    # The noise is independent, which is not assumed by default for so few trajectories.
    by_default, independent = share(), share("independent")
    errors = np.array([errors_of(each, ratios, truth) for each in found])
    width = np.mean([each.standard_error(ratios) for each in found], axis=0)
    opposite = [errors_of(estimated(i, -1), ratios, truth) for i in range(PAIRS)]
    pairs = (errors[:PAIRS] + opposite) / 2
    bias, own = np.mean(pairs, axis=0), np.std(pairs, axis=0) / np.sqrt(PAIRS)
    # With the steps that the fits above take; by default they would be refined without noise.
    exact = recorded(t, R, omega, rng(206), **dict.fromkeys(kinds, 0.0))
    clean = identify(Model(body, sensors), exact, lgvi.MoserVeselovIntegrator(interval, order=6))
    by_step = (np.asarray(ratios(clean.model)) - truth) / width
    unit = {"attitudes": "mrad", "rates": "mrad/s", "both": "mrad and mrad/s"}[kind]
    line(
        f"{f'{kind}, {1e3 * size:g} {unit}':42} {REPETITIONS} repetitions: intervals with truth "
        f"{text(100 * by_default, '.1f')} %, independent errors "
        f"{text(100 * independent, '.1f')} %; bias {text(bias, '.3f')} (+- {text(own, '.3f')}) and "
        f"without noise {text(by_step, '.0e')} standard errors"
    )
    assert np.all(by_default >= 0.91)
    assert np.all((independent >= 0.91) & (independent <= 0.98))
    assert np.all(np.abs(by_step) < 0.1)
    assert np.all(np.abs(bias) + 2 * own < 0.1)


def test_bad_starts_reach_the_same_minimum(line):
    """From rates 50 % wrong and an isotropic body, or the estimate says that it did not."""
    problems, tosses, interval, random = 100, 3, 0.02, rng(202)
    Js = physical_inertias(problems, 202)
    t, sensor = np.arange(40) * interval, lgvi.AttitudeSensor(1e-3)
    omega0 = random.uniform(0.2, 0.3, (problems * tosses, 1)) / interval
    omega0 = omega0 * directions(random, problems * tosses)
    Rs, omegas = motions(np.repeat(Js, tosses, axis=0), omega0, t)
    reached, silent, unequal = 0, [], []
    for i, J in enumerate(Js):
        of_problem = slice(i * tosses, (i + 1) * tosses)
        R, omega = Rs[of_problem], omegas[of_problem]
        given = recorded(t, R, omega, random, 1e-3)
        true = InitialStates(jnp.asarray(R[:, 0]), jnp.asarray(omega[:, 0]))
        best = identify(Model(lgvi.PhysicalRigidBody.from_inertia(J), sensor), given, start=true)
        size = np.linalg.norm(omega[:, 0], axis=1, keepdims=True)
        wrong = omega[:, 0] + 0.5 * size * directions(random, tosses)
        start = InitialStates(
            jnp.asarray(given.channels["attitude"].value[:, 0]), jnp.asarray(wrong)
        )
        found = identify(Model(ISOTROPIC, sensor), given, start=start)
        if abs(found.chi_square / best.chi_square - 1) < 1e-3:
            reached += 1
        else:
            words = f"{i}: {found.chi_square:.6g} not {best.chi_square:.6g} {found.messages}"
            unequal.append(words)
            if found.converged and not found.messages:
                silent.append(words)
    line(f"{'bad starts':42} {reached} of {problems} reach the minimum; others: {unequal}")
    assert reached >= 98
    assert not silent


COMMON = """
import resource, sys
from time import perf_counter
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings

file, samples = sys.argv[1], int(sys.argv[2])
t = np.arange(samples) * 0.02
body, sensor = lgvi.PhysicalRigidBody.from_principal_moments, lgvi.AttitudeSensor(1e-3)
"""
# In a process of its own, as to simulate takes memory too.
MAKE = """
random = np.random.default_rng(0)
omega = random.normal(size=(100, 3))
omega *= random.uniform(1, 2, (100, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
states = InitialStates.from_rates(omega)
true = Model(body([0.2, 0.35, 0.45]), sensor)
made = simulate_recordings(true, t, states, key=jax.random.key(0))
np.save(file, [each["attitude"][1] for each in made])
"""
FIT = """
recorded = Recordings.concatenate(
    Recordings.from_arrays(t, attitude=R, name=str(i))
    for i, R in enumerate(np.load(file, mmap_mode="r"))
)
start = perf_counter()
estimate = identify(Model(body([1.0, 1.0, 1.0]), sensor), recorded)
seconds, memory = perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
moments = lambda m: jnp.linalg.eigvalsh(m.body.inertia) / jnp.trace(m.body.inertia)
errors = (moments(estimate.model) - jnp.array([0.2, 0.35, 0.45])) / estimate.standard_error(moments)
print(seconds, memory, estimate.converged, jnp.max(abs(errors)))
"""


@pytest.mark.parametrize("samples", [10**3, 10**5])
def test_long_recordings(line, samples, tmp_path):
    """A hundred of them in one fit, in a process of its own."""
    for script in (MAKE, FIT):
        command = [sys.executable, "-c", COMMON + script, tmp_path / "made.npy", str(samples)]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, memory, converged, error = run.stdout.split()
    line(
        f"{f'100 recordings of {samples} samples':42} {float(seconds):.0f} s with compilation; "
        f"peak memory with the recordings {float(memory):.0f} MiB; "
        f"largest error {float(error):.1f} standard errors"
    )
    assert converged == "True"
    assert float(error) < 4
