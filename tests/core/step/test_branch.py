"""Of the roots of the equation, only the one that follows from the identity is a solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.core.kernels.vectors import Mat3, Vec3
from lgvi.core.step.equation import is_on_branch_of_identity, residual_norm

from ...systems import inertia, physical_inertias, rng

COUNT = 2000


def hats(v):
    return np.cross(np.eye(3), v[..., None, :])


@pytest.mark.parametrize("rotor", [False, True])
def test_a_root_counts_where_no_fold_lies_between_it_and_the_identity(rotor):
    """F Jd - Jd F^T + (F hat(r) + hat(r) F^T)/2 folds where tr(W) I - W is singular,
    W = F (Jd + hat(r)/2)."""
    random = rng(71, rotor)
    J = physical_inertias(COUNT, 71, ratio=1e-3)
    J /= np.trace(J, axis1=1, axis2=2)[:, None, None]
    Jd = np.eye(3) / 2 - J
    c = random.normal(size=(COUNT, 3))
    length, c = np.exp(random.uniform(-1, 2, COUNT)), c / np.linalg.norm(c, axis=1, keepdims=True)
    axis, c = c, length[:, None] * c
    r = rotor * 0.3 * random.normal(size=(COUNT, 3))
    # From the identity and a rotor at rest along a ray to c and r.
    part = np.linspace(0, 1, 1001)[:, None, None]
    angle = 2 * np.arctan(part * length[:, None])
    F = Rotation.from_rotvec((angle * axis).reshape(-1, 3)).as_matrix().reshape(-1, COUNT, 3, 3)
    W = F @ (Jd + hats(part * r) / 2)
    trace = np.trace(W, axis1=2, axis2=3)[..., None, None]
    fold = np.linalg.det(trace * np.eye(3) - W)
    expected = np.all(fold > 0, axis=0)
    assert 0.1 < np.mean(expected) < 0.9
    assert np.mean(fold[-1][~expected] > 0) > 0.1  # of which the determinant alone does not tell
    S = F[-1] @ (Jd + hats(r) / 2)
    S -= np.swapaxes(S, 1, 2)
    p = np.stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]], 1)
    of_rotor = Vec3.of(jnp.asarray(r)) if rotor else None
    J_, p_, c_ = Mat3.of(jnp.asarray(J)), Vec3.of(jnp.asarray(p)), Vec3.of(jnp.asarray(c))
    assert np.max(residual_norm(2 * J_, p_, c_, of_rotor)) < 1e-14  # all are roots
    on_branch = np.asarray(is_on_branch_of_identity(J_, c_, of_rotor))
    np.testing.assert_array_equal(on_branch, expected)


def test_a_matrix_that_is_no_inertia_of_a_body_is_judged_by_its_folds_alone():
    """A learner may pass there. A spin by h omega = sin(angle) folds at a right angle."""
    J = Mat3.of(jnp.diag(jnp.array([0.1, 0.1, 0.8])))
    for angle, expected in ((1.5, True), (1.64, False)):
        c = Vec3.of(jnp.array([0, 0, np.tan(angle / 2)]))
        assert is_on_branch_of_identity(J, c) == expected


@pytest.mark.slow
def test_thin_rods_in_a_batch_do_not_take_another_root_in_float32():
    steps, random = 20, rng(72)
    rod = inertia([1e-4, 0.9999, 1.0]) / 2
    axes = Rotation.random(10 * COUNT, rng=random).as_matrix()
    J = (axes @ rod @ np.swapaxes(axes, 1, 2)).astype(np.float32)
    J = (J + np.swapaxes(J, 1, 2)) / 2
    omega = random.normal(size=(len(J), 3))
    omega *= random.uniform(0.1, 0.4, (len(J), 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    pi = np.einsum("nij,nj->ni", J, omega).astype(np.float32)

    @jax.jit
    @jax.vmap
    def simulate(J, pi):
        R, _, info = lgvi.simulate_free_rigid_body(
            jnp.eye(3, dtype=J.dtype), pi, J, jnp.ones((), J.dtype), steps, tolerance=None
        )
        return R, jnp.all(info.converged)

    R, converged = simulate(J, pi)
    exact, exists = simulate(J.astype(float), pi.astype(float))
    assert np.all(exists)
    assert np.all(converged)
    error = np.max(abs(np.asarray(R) - np.asarray(exact)), axis=(1, 2, 3))
    rounding = 10 * steps * np.finfo(np.float32).eps * 1e4  # another root is off by 1 or 2
    assert np.max(error) < rounding
