"""The fitting example is as good as the noise allows, and says what is wrong with a file."""

import re

import fit_inertia
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ..systems import euler_equations, inertia, rng, rotation
from .free_motion import attitudes

TOSSES, SAMPLES, NOISE = 8, 50, 1e-3
AXES = Rotation.from_rotvec([0.4, -0.7, 0.5]).as_matrix()
J = inertia(fit_inertia.TRUTH, AXES)
T = np.arange(SAMPLES) / 50
DEGREES_OF_FREEDOM = 3 * TOSSES * SAMPLES - 6 * TOSSES - 5


def numbers(label, text):
    (line,) = re.findall(rf"^{re.escape(label)}:?(.*)$", text, re.MULTILINE)
    return np.array([float(word) for word in re.findall(r"[-+]?\d+\.\d+", line)])


def write(path, rows, header="t,qw,qx,qy,qz"):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def recipe():
    """First rates, attitudes, and noise of each toss, as the file states them."""
    random = np.random.default_rng(0)
    for _ in range(TOSSES):
        q, omega = random.normal(size=4), 3 * random.normal(size=3)
        noise = Rotation.from_rotvec(NOISE * random.normal(size=(SAMPLES, 3)))
        yield omega, attitudes(J, q, omega, T), noise


def angles(R, changed, omega):
    """From attitudes to those of another inertia and another first rate."""
    path, _ = euler_equations(R[0].as_matrix(), changed @ omega, changed, T)
    return (R.inv() * Rotation.from_matrix(path)).as_rotvec().ravel()


def standard_errors():
    """Of the moments of unit trace, by the information of all attitudes: the best there can be."""
    a, b, c = np.eye(3)
    changes = [np.diag(a - c), np.diag(b - c)]  # of the inertia in its principal axes
    changes += [np.outer(u, v) + np.outer(v, u) for u, v in ((a, b), (b, c), (c, a))]
    changes = [AXES @ change @ AXES.T for change in changes]
    information, eps = np.zeros((5, 5)), 1e-5
    for omega, R, _ in recipe():
        of_inertia = [angles(R, J + eps * change, omega) / eps for change in changes]
        of_rate = [angles(R, J, omega + eps * e) / eps for e in np.eye(3)]
        of_turn = (R.inv() * R[0]).as_matrix().reshape(-1, 3)
        A, B = np.stack(of_inertia, 1), np.column_stack([np.stack(of_rate, 1), of_turn])
        information += A.T @ (A - B @ np.linalg.lstsq(B, A, rcond=None)[0])
    covariance = NOISE**2 * np.linalg.inv(information)
    parts = np.zeros((3, 5))
    parts[:, :2] = [[1, 0], [0, 1], [-1, -1]]
    return np.sqrt(np.diag(parts @ covariance @ parts.T))


def test_the_recording_is_what_it_says():
    table = np.loadtxt(fit_inertia.TOSSES, delimiter=",", skiprows=7).reshape(TOSSES, SAMPLES, 6)
    for number, (toss, (_, R, noise)) in enumerate(zip(table, recipe(), strict=True)):
        assert np.all(toss[:, 0] == number)
        np.testing.assert_allclose(toss[:, 1], T, rtol=0, atol=1e-12)
        seen = Rotation.from_quat(toss[:, 2:], scalar_first=True)
        assert (seen.inv() * R * noise).magnitude().max() < 5e-7  # seven digits


def test_moments_of_the_recording_are_as_good_as_its_noise_allows(output):
    text = output(fit_inertia)
    moments, true = (
        numbers(label, text) for label in ("moments, as parts of the trace", "true ones")
    )
    errors = standard_errors()
    assert errors.max() < 2e-4
    np.testing.assert_array_equal(true, fit_inertia.TRUTH)
    assert np.all(abs(moments - true) < 4 * errors)
    expected = np.sqrt(DEGREES_OF_FREEDOM / (3 * TOSSES * SAMPLES))  # mrad
    bound = 4 * expected / np.sqrt(2 * DEGREES_OF_FREEDOM)
    assert abs(numbers("residual for each axis", text) - expected) < bound


def test_a_recording_of_tosses_of_unequal_lengths_gives_the_moments(output, tmp_path):
    # As many tosses as above, and as long a one, take the same program.
    random, rows = rng(31), []
    moments = np.array([1.0, 1.5, 2.0])
    J = inertia(moments, rotation(32))
    for toss in range(TOSSES):
        # Lengths and time stamps differ from toss to toss and sample to sample.
        t = 5.0 + np.cumsum(random.uniform(0.01, 0.03, SAMPLES - 4 * toss))
        omega = random.normal(size=3) * 2
        R, _ = euler_equations(rotation(33, toss), J @ omega, J, t)
        noise = Rotation.from_rotvec(2e-4 * random.normal(size=(len(t), 3)))
        q = (Rotation.from_matrix(R) * noise).as_quat(scalar_first=True)
        q *= random.choice([-1, 1], (len(t), 1))  # both signs are the same attitude
        table = np.column_stack([t, q])
        rows += [f"toss {toss}," + ",".join(f"{x:.9f}" for x in row) for row in table]
    file = write(tmp_path / "tosses.csv", rows, "trajectory,t,qw,qx,qy,qz")
    text = output(fit_inertia, "--data", file)
    assert "8 trajectories; samples: 288 of attitude\n" in text
    found = numbers("moments, as parts of the trace", text)
    np.testing.assert_allclose(found, moments / 4.5, rtol=2e-3)
    np.testing.assert_allclose(numbers("residual for each axis", text), 0.2, atol=0.015)
    assert "true ones" not in text


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["0,1,0,0,x"], "line 2, column `qz`"),
        (["0,1,0,0,0"], "must have two samples"),
        (None, "absent.csv"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(refusal, tmp_path, rows, words):
    file = tmp_path / "absent.csv" if rows is None else write(tmp_path / "bad.csv", rows)
    refused = refusal(fit_inertia, "--data", file)
    assert words in refused
    assert refused.count("\n") == 1
