"""The example finds an offset in a file, says where gravity does not fit, and refuses bad files."""

import re

import locate_centre_of_mass
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ..systems import euler_equations, inertia, rng, rotation
from .free_motion import attitudes

OFFSET, LENGTH = np.array([-1e-3, 2e-3, 6e-3]), 0.97


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Poses of tosses, by a reference that does not use the library; lengths are 3 % short."""
    random, rows = rng(511), ["trajectory,t,px,py,pz,qw,qx,qy,qz"]
    J, t = inertia([0.25, 0.35, 0.40], rotation(512)), np.arange(50) / 120
    for toss in range(12):
        omega = 8 * random.normal(size=3)
        R, _ = euler_equations(rotation(513, toss), J @ omega, J, t)
        x, v = random.normal(size=(2, 3))
        fall = np.outer(t**2 / 2, [0, 0, -9.81])
        p = LENGTH * (x + np.outer(t, v) + fall + R @ OFFSET) + 1e-4 * random.normal(size=(50, 3))
        seen = Rotation.from_matrix(R) * Rotation.from_rotvec(1e-3 * random.normal(size=(50, 3)))
        table = np.column_stack([np.full(50, toss), t, p, seen.as_quat(scalar_first=True)])
        rows += [",".join(f"{x:.9g}" for x in row) for row in table]
    path = tmp_path_factory.mktemp("poses") / "poses.csv"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def rows(text, of):
    return np.array(re.findall(rf"^position\.{of}\S* +(\S+) +(\S+)", text, re.MULTILINE), float).T


def test_the_recording_is_what_it_says():
    table = np.loadtxt(locate_centre_of_mass.POSES, delimiter=",", skiprows=10)
    J, t, random = np.diag([0.25, 0.35, 0.40]), np.arange(50) / 125, np.random.default_rng(0)
    flight = np.outer(t, [0.5, 0.2, 2.0]) + np.outer(t**2 / 2, [0, 0, -9.81])
    for number, toss in enumerate(table.reshape(12, 50, 9)):
        q, direction, begin = random.normal(size=4), random.normal(size=3), random.normal(size=3)
        R = attitudes(J, q, 8 * direction / np.linalg.norm(direction), t)
        p = 0.1 * begin + flight + R.apply(locate_centre_of_mass.OFFSET)
        p += 1e-4 * random.normal(size=(50, 3))
        noise = Rotation.from_rotvec(1e-3 * random.normal(size=(50, 3)))
        seen = Rotation.from_quat(toss[:, 5:], scalar_first=True)
        assert np.all(toss[:, 0] == number)
        np.testing.assert_allclose(toss[:, 1], t, rtol=0, atol=1e-12)
        np.testing.assert_allclose(toss[:, 2:5], p, rtol=0, atol=6e-7)
        assert (seen.inv() * R * noise).magnitude().max() < 5e-6


@pytest.mark.slow
def test_the_offset_is_found_once_the_scale_of_length_is_free(output, file, tmp_path):
    picture = tmp_path / "offset.png"
    text = output(locate_centre_of_mass, "--data", file, "--free", "length", "--plot", picture)
    assert text.splitlines()[3] == "verdict: the model holds"
    values, errors = rows(text, "offset")
    assert np.all(abs(values - OFFSET) < 4 * errors)
    assert np.all(errors < 5e-5)  # m
    (value, error) = rows(text, "length_scale")
    assert abs(value - LENGTH) < 4 * error
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_a_wrong_scale_of_length_is_in_the_verdict(output, file):
    verdict = output(locate_centre_of_mass, "--data", file).split("\n\n")[1]
    assert verdict.startswith("verdict: the model does not hold")
    assert "`position.length_scale`" in verdict


def test_bad_files_and_arguments_are_refused(tmp_path, refusal):
    absent = tmp_path / "absent.csv"
    assert "absent.csv" in refusal(locate_centre_of_mass, "--data", absent)
    assert "must be positive" in refusal(locate_centre_of_mass, "--sigma", 0)
    assert "invalid choice: 'mass'" in refusal(locate_centre_of_mass, "--free", "mass")
