"""Bodies with known axes: every value of the leaf gives an inertia that a body can have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import rng, rotation

AXES = rotation(230)
MOMENTS = np.array([2.1e-3, 3.0e-3, 4.2e-3])


def test_the_inertia_has_the_moments_and_the_axes():
    body = lgvi.KnownAxesRigidBody.from_principal_moments(MOMENTS, AXES)
    np.testing.assert_allclose(body.inertia, AXES @ np.diag(MOMENTS) @ AXES.T, rtol=1e-12)
    straight = lgvi.KnownAxesRigidBody.from_principal_moments(MOMENTS)
    np.testing.assert_allclose(straight.inertia, np.diag(MOMENTS), rtol=1e-12)


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -2), (1, 0, 0), (0.3, -0.5, 0.2)])
def test_an_axisymmetric_body_has_two_equal_moments(axis):
    body = lgvi.KnownAxesRigidBody.axisymmetric([3e-3, 4e-3], axis)
    assert body.log_second_moments.shape == (2,)
    direction = np.array(axis) / np.linalg.norm(axis)
    along = np.outer(direction, direction)
    expected = 4e-3 * along + 3e-3 * (np.eye(3) - along)
    np.testing.assert_allclose(body.inertia, expected, atol=1e-17)


@pytest.mark.parametrize("count", [2, 3])
def test_every_leaf_gives_a_possible_inertia(count):
    for key in range(50):
        leaf = 3 * rng(231, key).normal(size=count)
        body = lgvi.KnownAxesRigidBody(leaf, tuple(map(tuple, AXES.tolist())))
        smallest, middle, largest = np.linalg.eigvalsh(body.inertia)
        assert smallest > 0
        assert smallest + middle > largest * (1 - 1e-12)


def test_a_wrong_body_is_told():
    make = lgvi.KnownAxesRigidBody
    with pytest.raises(ValueError, match=r"`log_second_moments` must have shape \(3,\) or \(2,\)"):
        make(np.zeros(4), tuple(map(tuple, np.eye(3).tolist())))
    with pytest.raises(ValueError, match="`axes` must be three rows"):
        make(np.zeros(3), ((1.0, 0.0, 0.0),))
    with pytest.raises(RuntimeError, match="`moments` must satisfy the triangle inequality"):
        make.from_principal_moments([1.0, 1.0, 3.0])
    with pytest.raises(RuntimeError, match="`axes` must be orthogonal"):
        make.from_principal_moments([1.0, 1.0, 1.0], 2 * np.eye(3))
    with pytest.raises(RuntimeError, match="`moments` must satisfy the triangle inequality"):
        make.axisymmetric([1.0, 3.0])
    with pytest.raises(ValueError, match="`axis` must be three numbers"):
        make.axisymmetric([1.0, 1.0], (0, 0, 0))


def test_the_leaf_is_what_is_learned():
    """Axes are no leaf; the gradient is that of the inertia."""
    body = lgvi.KnownAxesRigidBody.axisymmetric([3e-3, 4e-3])
    assert [leaf.shape for leaf in jax.tree.leaves(body)] == [(2,)]
    gradient = jax.grad(lambda b: jnp.trace(b.inertia))(body)
    second = np.exp(np.asarray(body.log_second_moments))
    np.testing.assert_allclose(gradient.log_second_moments, second * [4, 2], rtol=1e-12)
