"""Intervals of few noisy attitudes contain the truth: normal ones, profiles, and draws of NUTS.

The bodies are drawn from the prior of the draws, uniform among the inertias of unit trace that a
body can have; their motions are Euler's equations, from SciPy. Of draws from the posterior the
intervals of 95 % then contain the truth in 95 %, if they are right. It takes an hour:
python -m pytest -n 0 -q -o python_files="proof_posterior.py" tests/benchmarks
"""

from time import process_time

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import Model, identify

from ..systems import rng
from .tosses import directions, motions, recorded, text

REPETITIONS, THROWS, SIGMA = 100, 3, 0.05  # SIGMA in rad
T = np.linspace(0, 2, 12)  # s
SPEED = 3.0  # rad/s
MODEL = Model(
    lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1 / 3)), lgvi.AttitudeSensor(SIGMA)
)


def ratios(model):
    return jnp.linalg.eigvalsh(model.body.inertia) / jnp.trace(model.body.inertia)


def ratio(k):
    return lambda model: ratios(model)[k]


RATIOS = [ratio(k) for k in range(3)]


def draw_inertia(random):
    """An inertia of unit trace: the density of X X^T is constant, of a normal X (3, 4)."""
    X = random.normal(size=(3, 4))
    second_moments = X @ X.T / (2 * np.sum(X**2))
    return np.eye(3) / 2 - second_moments


def test_intervals_contain_the_truth(line):
    hits, seconds = {"normal": [], "profile": [], "NUTS": []}, {"profile": [], "NUTS": []}
    left_out = dict.fromkeys(hits, 0)

    def note(kind, lower, upper):
        hits[kind].append((lower < truth) & (truth < upper))

    for repetition in range(REPETITIONS):
        random = rng(220, repetition)
        J = draw_inertia(random)
        truth = np.linalg.eigvalsh(J)
        speeds = SPEED * random.uniform(0.7, 1.3, (THROWS, 1))
        R, omega = motions(J, speeds * directions(random, THROWS), T)
        estimate = identify(MODEL, recorded(T, R, omega, random, SIGMA), noise="given")
        note("normal", *map(np.asarray, estimate.interval(ratios)))
        start = process_time()
        try:
            profiles = [estimate.profile(quantity) for quantity in RATIOS]
            note("profile", *np.array([(p.lower, p.upper) for p in profiles]).T)
        except RuntimeError:
            left_out["profile"] += 1
        seconds["profile"].append(process_time() - start)
        start = process_time()
        try:
            draws = estimate.sample(1000, jax.random.key(repetition))
            note("NUTS", *map(np.asarray, draws.interval(ratios)))
        except RuntimeError:
            left_out["NUTS"] += 1
        seconds["NUTS"].append(process_time() - start)
    for kind, of_kind in hits.items():
        share = np.mean(of_kind, axis=0)
        took = f"; {np.median(seconds[kind]):.1f} s each" if kind in seconds else ""
        line(
            f"{kind:8}: {text(100 * share, '.0f')} %, {100 * np.mean(share):.1f} % in all, of "
            f"{len(of_kind)}; {left_out[kind]} refused{took}"
        )
    assert 0.92 <= np.mean(hits["NUTS"]) <= 0.98
