"""Intervals where normal ones fail: a nearly spherical body, of which few attitudes are read.

The eigenvalues of a matrix that is nearly a multiple of the identity are far from linear in its
entries. The bodies are drawn from the prior that the fit is given; their motions are Euler's
equations, from SciPy. Of draws from the posterior the intervals of 95 % then contain the truth in
95 %, if they are right. It takes ten minutes:
python -m pytest -n 0 -q -o python_files="proof_posterior.py" tests/benchmarks
"""

from time import process_time

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import Model, identify

from ..identification.recorded import ratios
from ..systems import rng
from .tosses import directions, motions, recorded, text

REPETITIONS, SIGMA = 100, 0.05  # SIGMA in rad
UNLIKE = 0.02  # how far the entries of the inertia over its trace are from those of a sphere
T = np.linspace(0, 2, 8)  # s
SPEED = 3.0  # rad/s
MODEL = Model(
    lgvi.PhysicalRigidBody.from_principal_moments([0.330, 0.333, 0.337]),
    lgvi.AttitudeSensor(SIGMA),
)


def shape(model):
    return model.body.inertia / jnp.trace(model.body.inertia) - jnp.eye(3) / 3


def draw_inertia(random):
    """An inertia of unit trace, whose density is normal in the distance from that of a sphere."""
    X = random.normal(size=(3, 3))
    X = (X + X.T) / 2
    return np.eye(3) / 3 + UNLIKE * (X - np.trace(X) / 3 * np.eye(3))


def test_intervals_contain_the_truth(line):
    hits, seconds, refused = {"normal": [], "NUTS": []}, [], 0
    for repetition in range(REPETITIONS):
        random = rng(220, repetition)
        J = draw_inertia(random)
        truth = np.linalg.eigvalsh(J)
        assert truth[2] < 0.5
        omega0 = SPEED * random.uniform(0.7, 1.3) * directions(random, 1)
        R, omega = motions(J, omega0, T)
        log = recorded(T, R, omega, random, SIGMA)
        estimate = identify(MODEL, log, noise="given", prior=[(shape, np.zeros((3, 3)), UNLIKE)])
        intervals, start = {"normal": estimate.interval(ratios)}, process_time()
        try:
            draws = estimate.sample(1000, jax.random.key(repetition))
            intervals["NUTS"] = draws.interval(ratios)
        except RuntimeError:
            refused += 1
        seconds.append(process_time() - start)
        for kind, (lower, upper) in intervals.items():
            hits[kind].append((np.asarray(lower) < truth) & (truth < np.asarray(upper)))
    for kind, of_kind in hits.items():
        share = np.mean(of_kind, axis=0)
        line(f"{kind:8}: {text(100 * share, '.0f')} %, {100 * np.mean(share):.1f} % in all")
    line(
        f"{refused} of {REPETITIONS} refused; draws in {np.median(seconds):.1f} s of processor time"
    )
    assert refused <= 0.05 * REPETITIONS
    assert 0.92 <= np.mean(hits["NUTS"]) <= 0.98
    assert np.min(np.mean(hits["normal"], axis=0)) < 0.85
