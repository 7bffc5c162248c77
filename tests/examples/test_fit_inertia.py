"""The fitting example recovers known inertias, and says what is wrong with a file."""

import re
import subprocess
import sys
from pathlib import Path

import fit_inertia
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgvi.identification import Recordings, initial_states

from ..systems import euler_equations, inertia, rng, rotation

EXAMPLES = Path(__file__).parents[2] / "examples"
HEADER = "t,qw,qx,qy,qz"


def run(*arguments):
    command = [sys.executable, str(EXAMPLES / "fit_inertia.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def numbers(label, text):
    (line,) = re.findall(rf"^{re.escape(label)}:?(.*)$", text, re.MULTILINE)
    return np.array([float(word) for word in re.findall(r"[-+]?\d+\.\d+", line)])


def write(path, rows, header=HEADER):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_synthetic_tosses_give_the_moments_within_half_a_percent(tmp_path):
    result = run("--tosses", 3, "--plot", tmp_path / "fit.png")
    assert result.returncode == 0, result.stderr
    wrong = re.search(r"an inertia that is (\d+)% wrong", result.stdout)
    assert wrong
    assert int(wrong[1]) >= 30
    assert np.all(np.abs(numbers("relative errors", result.stdout)) < 0.5)
    estimated = numbers("estimated moments (unit trace)", result.stdout)
    true = numbers("true moments", result.stdout)
    np.testing.assert_allclose(estimated, true, rtol=5e-3)
    # 900 numbers of noise: the standard error of their deviation is 2.4 %.
    np.testing.assert_allclose(numbers("residual per axis", result.stdout), 1, atol=0.1)
    assert "settled" in result.stdout
    assert "NOT settled" not in result.stdout
    assert (tmp_path / "fit.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_recording_of_short_tosses_gives_the_moment_ratios_and_names_the_outlier(tmp_path):
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
    result = run("--data", file, "--drop-above", 3)
    assert result.returncode == 0, result.stderr
    assert "data: 12 trajectories; samples: 234 of attitude\n" in result.stdout
    step = r"^step: \d\d for each sample, of at most 0\.0(19|20) rad$"
    assert re.search(step, result.stdout, re.MULTILINE)
    assert "dropped: trajectory toss 7 (above 3 times the median)\n" in result.stdout
    ratios = numbers("their ratio to the mean", result.stdout)
    np.testing.assert_allclose(ratios, moments / 1.5, rtol=2e-3)
    np.testing.assert_allclose(numbers("residual per axis", result.stdout), 0.2, atol=0.015)


def test_running_out_of_iterations_is_said(capsys):
    # Examples run with the settings of a user, which are laxer than those of the tests.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        recordings, truth = fit_inertia.synthetic_tosses(2, noise=1e-3, seed=0)
        recorded = fit_inertia.attitudes_of(recordings)
        guess = fit_inertia.initial_guess(recorded, initial_states(recordings), truth)
        fit_inertia.fit(guess, recorded, 1, iterations=2)
    assert "NOT settled after 2 iterations" in capsys.readouterr().out


def test_the_step_follows_the_recorded_motion():
    J = inertia([1.0, 1.5, 2.0])
    t = np.arange(15) * 0.05
    R, _ = euler_equations(np.eye(3), J @ np.array([1.0, 1.5, -0.5]), J, t)
    recorded = fit_inertia.attitudes_of(Recordings.from_arrays(t, attitude=R))
    # 1.9 rad/s for 0.05 s, at most 0.02 rad in a step.
    turn = float(fit_inertia.largest_turn(recorded))
    assert abs(turn - 0.1) < 0.02
    assert fit_inertia.steps_per_sample(turn) in (5, 6)
    assert 0.01 < turn / fit_inertia.steps_per_sample(turn) < 0.02


def test_the_command_line_reports_a_bad_file_without_a_traceback(tmp_path):
    result = run("--data", write(tmp_path / "bad.csv", ["0,1,0,0,x"]))
    assert result.returncode == 2
    assert "line 2, column `qz`" in result.stderr
    assert "Traceback" not in result.stderr
    missing = run("--data", tmp_path / "absent.csv")
    assert missing.returncode == 2
    assert "absent.csv" in missing.stderr
    assert "Traceback" not in missing.stderr
