"""A learned torque predicts what has not been seen, and frees the inertia of its bias."""

import re
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import learned_torque
import numpy as np
import pytest

import lgvi


def run(*arguments):
    command = [sys.executable, learned_torque.__file__, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def numbers(pattern, text):
    return [float(x) for x in re.findall(pattern, text)]


def test_a_few_iterations_report_both_fits():
    result = run("--iterations", 2)
    assert result.returncode == 0, result.stderr
    assert len(numbers(r"unseen motions: (\S+) rad off", result.stdout)) == 2


@pytest.mark.slow
def test_the_learned_torque_beats_no_torque_on_unseen_motions():
    result = run("--iterations", 300)
    assert result.returncode == 0, result.stderr
    without, learned = numbers(r"unseen motions: (\S+) rad off", result.stdout)
    assert without > 0.1  # the torque matters
    assert learned < 0.2 * without
    without, learned = numbers(r"residual .*: (\S+) mrad", result.stdout)
    assert learned < 0.2 * without
    without, learned = numbers(r"largest error of an entry: (\S+)", result.stdout)
    assert learned < 0.5 * without
    without, learned = numbers(r"torque .*: (\S+) % off", result.stdout)
    assert without == 100
    assert learned < 30


def test_a_turn_about_the_vertical_changes_no_torque():
    network = eqx.nn.MLP(3, 3, 4, 1, key=jax.random.key(0))
    torque, t = learned_torque.LearnedTorque(network), jnp.zeros(())
    R = learned_torque.random_states(1, seed=1).R[0]
    turned = lgvi.so3.exp(jnp.array([0.0, 0.0, 1.0])) @ R
    np.testing.assert_allclose(torque(t, R), network(R[2]))
    for law in (learned_torque.true_torque, torque):
        np.testing.assert_allclose(law(t, turned), law(t, R), rtol=1e-12)
        assert np.linalg.norm(law(t, R)) > 0.01


def test_bad_arguments_are_refused(refusal):
    assert "--iterations must be at least 1" in refusal(learned_torque, "--iterations", 0)
