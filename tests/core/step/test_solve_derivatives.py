"""Derivatives of one step: every mode, every argument, both precisions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ...derivatives import assert_first_derivatives_agree, assert_second_derivatives_agree
from ...oracle import oracle_F
from ...systems import FLAT, GENERIC, PI0, SPHERE, SYMMETRIC_TOP, momenta, physical_inertias

BODIES = np.concatenate([physical_inertias(6, 1, ratio=0.2), [FLAT, SPHERE, SYMMETRIC_TOP]])
H = np.linspace(0.2, 0.4, len(BODIES))


def at_rest():
    return jnp.zeros((len(BODIES), 3)), jnp.asarray(BODIES), jnp.full(len(BODIES), 0.3)


def and_at_rest(points):
    return [jnp.concatenate(pair) for pair in zip(points, at_rest(), strict=True)]


def points():
    pi = momenta(BODIES, 0.7, 2, h=0.4)
    return jnp.asarray(pi), jnp.asarray(BODIES), jnp.asarray(H)


def test_derivatives_with_respect_to_momentum_inertia_and_step():
    jacobian = assert_first_derivatives_agree(lgvi.solve_F, *and_at_rest(points()), rtol=1e-12)
    # Columns: pi, J, h.
    by_J = jacobian[..., 3:12].reshape(-1, 9, 3, 3)
    np.testing.assert_allclose(by_J, np.swapaxes(by_J, 2, 3), rtol=0, atol=1e-14)
    # At rest F = I + h hat(J^-1 pi): the derivative in pi has a known value.
    first = jacobian[len(BODIES) :, :, :3].reshape(-1, 3, 3, 3)
    turns = 0.3 * np.linalg.inv(BODIES)
    np.testing.assert_allclose(first[:, 2, 1], turns[:, 0], rtol=1e-13)
    np.testing.assert_allclose(first[:, 0, 2], turns[:, 1], rtol=1e-13)
    np.testing.assert_allclose(first[:, 1, 0], turns[:, 2], rtol=1e-13)


def test_derivative_is_that_of_the_root_found_in_exponential_coordinates():
    change = 1e-4

    def difference(f):
        return (f(change) - f(-change)) / (2 * change)

    dpi, dJ, dh = np.array([0.3, -0.2, 0.5]), physical_inertias(1, 3)[0], 0.7
    numeric = difference(lambda s: oracle_F(PI0 + s * dpi, GENERIC + s * dJ, 0.3 + s * dh))
    _, tangent = jax.jvp(
        jax.jit(lgvi.solve_F), tuple(map(jnp.asarray, (PI0, GENERIC, 0.3))), (dpi, dJ, dh)
    )
    np.testing.assert_allclose(tangent, numeric, rtol=0, atol=1e-8)


def test_second_derivatives():
    args = and_at_rest([x[:4] for x in points()])
    hessian = assert_second_derivatives_agree(lgvi.solve_F, *args, rtol=1e-12)
    assert np.max(np.abs(hessian[4:, ..., :3, :3])) > 1e-3


jacobians = jax.jit(jax.vmap(jax.jacrev(lgvi.solve_F, argnums=(0, 1, 2))))


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_derivatives_do_not_lose_accuracy_at_any_scale(dtype, scale):
    """(J, pi) -> scale (J, pi) leaves F, so derivatives in J and pi are divided by scale."""
    pi, J, h = (jnp.asarray(x, dtype) for x in points())
    desired = jacobians(*(jnp.asarray(x, float) for x in (pi, J, h)))
    actual = jacobians(scale * pi, scale * J, h)
    for a, d, factor in zip(actual, desired, (scale, scale, 1.0), strict=True):
        assert a.dtype == dtype
        error = np.max(np.abs(factor * np.asarray(a, float) - d)) / np.max(np.abs(d))
        assert error < 100 * float(jnp.finfo(dtype).eps)


def test_the_residual_has_no_derivative():
    def norm(pi, J, h):
        return lgvi.solve_F_with_info(pi, J, h, 1)[1].residual_norm

    gradient = jax.jit(jax.grad(norm, argnums=(0, 1, 2)))(PI0, GENERIC, 0.5)
    for part in gradient:
        np.testing.assert_array_equal(part, np.zeros_like(part))


def test_derivatives_do_not_depend_on_the_budget_that_converged():
    pi, J, h = points()

    def derivative(newton_iters):
        solve = partial(lgvi.solve_F, newton_iters=newton_iters)
        return jax.jit(jax.vmap(jax.jacfwd(solve)))(pi, J, h)

    np.testing.assert_allclose(derivative(8), derivative(30), rtol=0, atol=1e-14)
