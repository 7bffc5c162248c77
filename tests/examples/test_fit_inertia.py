"""The fitting example recovers known inertias, and says what is wrong with a file."""

import re

import fit_inertia
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ..systems import euler_equations, inertia, rng, rotation

HEADER = "t,qw,qx,qy,qz"


def numbers(label, text):
    (line,) = re.findall(rf"^{re.escape(label)}:?(.*)$", text, re.MULTILINE)
    return np.array([float(word) for word in re.findall(r"[-+]?\d+\.\d+", line)])


def write(path, rows, header=HEADER):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_synthetic_tosses_give_the_moments_within_half_a_percent(output, tmp_path):
    text = output(fit_inertia, "--tosses", 3, "--plot", tmp_path / "fit.png")
    start, truth = (np.asarray(each.inertia) for each in (fit_inertia.START, fit_inertia.TRUTH))
    assert np.linalg.norm(start - truth) > 0.3 * np.linalg.norm(truth)
    estimated, true = (
        numbers(words, text) for words in ("moments, as parts of the trace", "true ones")
    )
    np.testing.assert_allclose(estimated, true, rtol=5e-3)
    # 900 numbers of noise: the standard error of their deviation is 2.4 %.
    np.testing.assert_allclose(numbers("residual for each axis", text), 1, atol=0.1)
    assert "NOT settled" not in text
    assert (tmp_path / "fit.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_recording_of_short_tosses_gives_the_moments(output, tmp_path):
    random = rng(31)
    moments = np.array([1.0, 1.5, 2.0])
    J = inertia(moments, rotation(32))
    rows = []
    for toss in range(12):
        # Lengths and time stamps differ from toss to toss and sample to sample.
        t = 5.0 + np.cumsum(random.uniform(0.02, 0.06, 14 + toss))
        omega = random.normal(size=3) * 2
        R, _ = euler_equations(rotation(33, toss), J @ omega, J, t)
        noise = Rotation.from_rotvec(2e-4 * random.normal(size=(len(t), 3)))
        q = (Rotation.from_matrix(R) * noise).as_quat(scalar_first=True)
        q *= random.choice([-1, 1], (len(t), 1))  # both signs are the same attitude
        table = np.column_stack([t, q])
        rows += [f"toss {toss}," + ",".join(f"{x:.9f}" for x in row) for row in table]
    file = write(tmp_path / "tosses.csv", rows, "trajectory," + HEADER)
    text = output(fit_inertia, "--data", file)
    assert "12 trajectories; samples: 234 of attitude\n" in text
    found = numbers("moments, as parts of the trace", text)
    np.testing.assert_allclose(found, moments / 4.5, rtol=2e-3)
    np.testing.assert_allclose(numbers("residual for each axis", text), 0.2, atol=0.015)
    assert "true ones" not in text


def test_running_out_of_iterations_is_said(output):
    # As many tosses as above take the same program.
    assert "NOT settled after 2 iterations" in output(fit_inertia, "--tosses", 3, "--iterations", 2)


def test_the_command_line_reports_a_bad_file_without_a_traceback(refusal, tmp_path):
    bad = refusal(fit_inertia, "--data", write(tmp_path / "bad.csv", ["0,1,0,0,x"]))
    assert "line 2, column `qz`" in bad
    assert "Traceback" not in bad
    missing = refusal(fit_inertia, "--data", tmp_path / "absent.csv")
    assert "absent.csv" in missing
    assert "Traceback" not in missing
