"""The example identifies moments from a file, names what spoils them, and refuses bad files."""

import re

import identify_real_attitudes
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ..systems import euler_equations, inertia, rng, rotation
from .free_motion import attitudes

MOMENTS = np.array([0.20, 0.38, 0.42])
SIGMA = 5e-4


def write(path, rows, header="toss,trajectory,t,qw,qx,qy,qz"):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def tosses(spoilt):
    """Rows of 30 short tosses, by a reference that does not use the library."""
    random, rows = rng(501), []
    J, t = inertia(MOMENTS, rotation(502)), 3.0 + np.arange(15) / 148
    for toss in range(30):
        omega = random.normal(size=3)
        omega *= 5.0 / np.linalg.norm(omega)
        R, _ = euler_equations(rotation(503, toss), J @ omega, J, t)
        noise = SIGMA * random.normal(size=(15, 3))
        noise[8:] += 0.02 * (f"toss {toss}" in spoilt)
        q = (Rotation.from_matrix(R) * Rotation.from_rotvec(noise)).as_quat(scalar_first=True)
        table = np.column_stack([t, q])
        rows += [f"x,toss {toss}," + ",".join(f"{x:.9f}" for x in row) for row in table]
    return rows


def moments(text):
    """Values and standard errors of the last table."""
    rows = re.findall(r"^principal moment, \w+ +(\S+) +(\S+)", text, re.MULTILINE)[-3:]
    return np.array(rows, float).T


@pytest.mark.slow
def test_a_file_gives_the_moments_and_what_spoilt_them_is_dropped(output, tmp_path):
    file = write(tmp_path / "tosses.csv", tosses({"toss 4", "toss 19"}))
    given = "--data", file, "--sigma", SIGMA, "--drop", "--plots", tmp_path / "plots"
    text = output(identify_real_attitudes, *given)
    before, after = text.split("fit without these trajectories")
    assert "trajectories that do not fit: 2: toss 4, toss 19\n" in before
    assert "dropped: trajectory toss 4, toss 19 (does not fit)\n" in after
    assert "trajectories: 28," in after
    assert "trajectories that do not fit" not in after
    assert "NOT CONVERGED" not in text
    values, errors = moments(after)
    assert np.all(abs(values - MOMENTS) < 4 * errors)
    assert np.all(errors < 0.02)  # so the moments are told apart
    residual = re.search(r"attitude: residual (\S+) rad", after)
    assert residual
    np.testing.assert_allclose(float(residual[1]), SIGMA, rtol=0.1)
    for name in ("residuals", "fit", "moments"):
        assert (tmp_path / "plots" / f"{name}.png").stat().st_size > 10_000


def test_the_recording_is_what_it_says():
    table = np.loadtxt(identify_real_attitudes.THROWS, delimiter=",", skiprows=8)
    J, t, random = (
        np.diag(identify_real_attitudes.TRUTH),
        np.arange(15) / 150,
        np.random.default_rng(0),
    )
    for number, throw in enumerate(table.reshape(40, 15, 6)):
        q, direction = random.normal(size=4), random.normal(size=3)
        R = attitudes(J, q, 4 * direction / np.linalg.norm(direction), t)
        noise = Rotation.from_rotvec(5e-4 * random.normal(size=(15, 3)))
        jump = np.outer(np.arange(15) >= 7, [0, 0.02, 0]) * (number in (7, 23))
        seen = Rotation.from_quat(throw[:, 2:], scalar_first=True)
        assert np.all(throw[:, 0] == number)
        np.testing.assert_allclose(throw[:, 1], t, rtol=0, atol=1e-6)
        assert (seen.inv() * R * noise * Rotation.from_rotvec(jump)).magnitude().max() < 5e-7


def test_bad_files_and_arguments_are_refused(tmp_path, refusal):
    rows = tosses(())
    rows[20] = rows[20].rpartition(",")[0] + ",zero"
    file = write(tmp_path / "bad.csv", rows)
    words = refusal(identify_real_attitudes, "--data", file, "--plots", tmp_path / "plots")
    assert words.startswith(f"{file}, line 22, column `qz`: must be a number")
    assert not (tmp_path / "plots").exists()
    absent = refusal(identify_real_attitudes, "--data", tmp_path / "absent.csv")
    assert "absent.csv" in absent
    assert "--sigma must be positive" in refusal(identify_real_attitudes, "--sigma", 0)
