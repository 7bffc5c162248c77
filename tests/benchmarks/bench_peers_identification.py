"""The inertia from ten throws beside `mujoco.sysid` and SciPy, in one run.

Errors and coverage of the intervals that each gives, and processor time of the first and of further
fits. Motions are those of Euler's equations, from SciPy. It takes half an hour.
"""

import logging
from contextlib import redirect_stdout
from io import StringIO
from time import process_time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ..systems import inertia, rng, rotation
from .peers_identification import (
    FITS,
    LINES,
    SIGMA_OMEGA,
    SIGMA_R,
    Throws,
    count_lines,
    has_sysid,
)
from .proof_intervals import correlated, white
from .tosses import directions, motions, text

REPETITIONS, THROWS = 100, 10
T = np.arange(50) * 0.02  # s
TRUTH = np.array([1.0, 1.6, 2.2]) / 4.8
J = inertia(TRUTH, rotation(201))
DRAG = 1e-3  # quadratic, that no fit knows: N m s², for an inertia of unit trace
CASES = {
    "white noise": (white, 0.0),
    "noise correlated by 0.9": (correlated(0.9), 0.0),
    "drag that no fit knows": (white, DRAG),
}


def record(case: str, repetition: int) -> Throws:
    noise, drag = CASES[case]
    random = rng(230, repetition)
    omega0 = random.uniform(5, 10, (THROWS, 1)) * directions(random, THROWS)

    def torque(omega):
        return -drag * np.linalg.norm(omega, axis=1, keepdims=True) * omega

    R, omega = motions(J, omega0, T, torque if drag else None)
    turns = Rotation.from_rotvec(SIGMA_R * noise(random, omega.shape).reshape(-1, 3))
    read = R @ turns.as_matrix().reshape(R.shape)
    return Throws(T, read, omega + SIGMA_OMEGA * noise(random, omega.shape), (R[:, 0], omega[:, 0]))


@pytest.mark.parametrize("case", CASES)
def test_the_inertia_beside_the_peers(line, once, case):
    line(f"{case + ', ' + str(THROWS) + ' throws':36} errors of moments / sum   coverage   s")
    for name, fit in FITS.items():
        if "sysid" in name and not has_sysid():
            line(f"{name}: `mujoco[sysid]` is not installed, and was not measured")
            continue
        errors, hits, seconds = [], [], []
        for repetition in range(1 if once else REPETITIONS):
            throws, start = record(case, repetition), process_time()
            logging.disable(logging.WARNING)
            with redirect_stdout(StringIO()):  # of what sysid writes
                fitted = fit(throws)
            logging.disable(logging.NOTSET)
            seconds.append(process_time() - start)
            errors.append(np.asarray(fitted.moments) - TRUTH)
            hits.append((fitted.lower < TRUTH) & (fitted.upper > TRUTH))
        size = np.sqrt(np.mean(np.square(errors), axis=0))
        further = f", then {np.median(seconds[1:]):.2f}" if seconds[1:] else ""
        line(
            f"{name:36} {text(size, '.1e')}  {text(100 * np.mean(hits, axis=0), '.0f')} %  "
            f"first {seconds[0]:.2f}{further}"
        )
    counts = [f"{name} {count_lines(fit)}" for name, fit in LINES.items()]
    line(f"lines of code: {', '.join(counts)}")
