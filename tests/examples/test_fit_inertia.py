"""The fitting example recovers known inertias, and says what is wrong with a file."""

import re

import fit_inertia
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgvi.identification import Recordings

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
    wrong = re.search(r"an inertia that is (\d+)% wrong", text)
    assert wrong
    assert int(wrong[1]) >= 30
    assert np.all(np.abs(numbers("relative errors", text)) < 0.5)
    estimated = numbers("estimated moments (unit trace)", text)
    true = numbers("true moments", text)
    np.testing.assert_allclose(estimated, true, rtol=5e-3)
    # 900 numbers of noise: the standard error of their deviation is 2.4 %.
    np.testing.assert_allclose(numbers("residual per axis", text), 1, atol=0.1)
    assert "settled" in text
    assert "NOT settled" not in text
    assert (tmp_path / "fit.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_recording_of_short_tosses_gives_the_moment_ratios_and_names_the_outlier(
    output, tmp_path
):
    random = rng(31)
    moments = np.array([1.0, 1.5, 2.0])
    J = inertia(moments, rotation(32))
    rows = []
    for toss in range(12):
        # Lengths and time stamps differ from toss to toss and sample to sample.
        t = 5.0 + np.cumsum(random.uniform(0.02, 0.06, 14 + toss))
        omega = random.normal(size=3) * 2
        R, _ = euler_equations(rotation(33, toss), J @ omega, J, t)
        sigma = 1e-2 if toss == 7 else 2e-4
        noise = Rotation.from_rotvec(sigma * random.normal(size=(len(t), 3)))
        q = (Rotation.from_matrix(R) * noise).as_quat(scalar_first=True)
        q *= random.choice([-1, 1], (len(t), 1))  # both signs are the same attitude
        table = np.column_stack([t, q])
        rows += [f"toss {toss}," + ",".join(f"{x:.9f}" for x in row) for row in table]
    file = write(tmp_path / "tosses.csv", rows, "trajectory," + HEADER)
    text = output(fit_inertia, "--data", file, "--drop-above", 3)
    assert "data: 12 trajectories; samples: 234 of attitude\n" in text
    step = r"^step: \d\d for each sample, of at most 0\.0(19|20) rad$"
    assert re.search(step, text, re.MULTILINE)
    assert "dropped: trajectory toss 7 (above 3 times the median)\n" in text
    ratios = numbers("their ratio to the mean", text)
    np.testing.assert_allclose(ratios, moments / 1.5, rtol=2e-3)
    np.testing.assert_allclose(numbers("residual per axis", text), 0.2, atol=0.015)


def test_running_out_of_iterations_is_said(output):
    # As many tosses as above take the same program.
    assert "NOT settled after 2 iterations" in output(fit_inertia, "--tosses", 3, "--iterations", 2)


def test_the_step_follows_the_recorded_motion():
    J = inertia([1.0, 1.5, 2.0])
    t = np.arange(15) * 0.05
    R, _ = euler_equations(np.eye(3), J @ np.array([1.0, 1.5, -0.5]), J, t)
    recorded = fit_inertia.attitudes_of(Recordings.from_arrays(t, attitude=R))
    # 1.9 rad/s for 0.05 s, at most 0.02 rad in a step.
    turn = fit_inertia.largest_turn(recorded)
    assert abs(turn - 0.1) < 0.02
    assert fit_inertia.steps_per_sample(turn) in (5, 6)
    assert 0.01 < turn / fit_inertia.steps_per_sample(turn) < 0.02


def test_the_command_line_reports_a_bad_file_without_a_traceback(refusal, tmp_path):
    bad = refusal(fit_inertia, "--data", write(tmp_path / "bad.csv", ["0,1,0,0,x"]))
    assert "line 2, column `qz`" in bad
    assert "Traceback" not in bad
    missing = refusal(fit_inertia, "--data", tmp_path / "absent.csv")
    assert "absent.csv" in missing
    assert "Traceback" not in missing
