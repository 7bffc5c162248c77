"""A learned torque predicts what has not been seen, and frees the inertia of its bias."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import learned_torque
import numpy as np
import pytest

import lgvi

from .pages import assert_page_shows


def numbers(pattern, text):
    return [float(x) for x in re.findall(pattern, text)]


@pytest.mark.slow
def test_the_learned_torque_beats_no_torque_on_unseen_motions(output, tmp_path):
    text = output(learned_torque, "--plot", tmp_path / "torque.png")
    assert_page_shows("learned_torque", text)
    assert (tmp_path / "torque.png").stat().st_size > 10_000
    without, learned = numbers(r"unseen motions: (\S+) rad off", text)
    assert without > 0.1  # the torque matters
    assert learned < 0.2 * without
    without, learned = numbers(r"residual .*: (\S+) mrad", text)
    assert learned < 0.2 * without
    without, learned = numbers(r"largest error of an entry .*: (\S+)", text)
    assert learned < 0.5 * without
    without, learned = numbers(r"torque .*: (\S+) % off", text)
    assert without == 100
    assert learned < 30


def test_a_turn_about_the_vertical_changes_no_torque():
    network = eqx.nn.MLP(3, 3, 4, 1, key=jax.random.key(0))
    torque, t = learned_torque.LearnedTorque(network), jnp.zeros(())
    R = jnp.asarray(learned_torque.random_states(1, seed=1)[0][0])
    turned = lgvi.so3.exp(jnp.array([0.0, 0.0, 1.0])) @ R
    np.testing.assert_allclose(torque(t, R), network(R[2]))
    for law in (learned_torque.true_torque, torque):
        np.testing.assert_allclose(law(t, turned), law(t, R), rtol=1e-12)
        assert np.linalg.norm(law(t, R)) > 0.01
