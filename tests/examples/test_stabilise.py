"""The controller of the example settles the body, and its gains can be learned."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stabilise


@pytest.fixture(scope="module")
def cost():
    return jax.jit(jax.value_and_grad(stabilise.cost, has_aux=True))


@pytest.mark.slow
def test_the_body_settles(cost):
    (_, angles), _ = cost(jnp.log(stabilise.FIRST_GAINS))
    np.testing.assert_allclose(angles[0], 0.8, rtol=1e-12)
    assert angles[-1] < 2e-3


@pytest.mark.slow
def test_the_cost_is_differentiable_in_the_gains(cost):
    gains, step = jnp.log(stabilise.FIRST_GAINS), 1e-5
    _, gradient = cost(gains)
    for i, e in enumerate(jnp.eye(2)):
        ends = [cost(gains + s * step * e)[0][0] for s in (1, -1)]
        np.testing.assert_allclose(gradient[i], (ends[0] - ends[1]) / (2 * step), rtol=1e-6)


@pytest.mark.slow
def test_tuning_reports_what_it_gained(output, tmp_path):
    picture = tmp_path / "stabilise.png"
    text = output(stabilise, "--iterations", 10, "--plot", picture)
    first, tuned = (float(x) for x in re.findall(r"cost (\S+)", text))
    assert tuned < 0.95 * first
    assert picture.stat().st_size > 10_000
