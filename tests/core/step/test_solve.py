"""The discrete Moser-Veselov equation: its root, its solvability, what the solver reports."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ...systems import BODIES, GENERIC, PI0, hat, momenta, physical_inertias
from ..steps import COUNT, H, eps, oracle, random_steps, residual_norms, solver, traces


def test_F_is_the_rotation_that_solves_the_equation(dtype):
    pi, J = random_steps(dtype, 0.99, 1)
    F, info = solver()(pi, J, jnp.asarray(H, dtype), None)
    assert F.dtype == info.residual_norm.dtype == dtype
    assert info.converged.dtype == bool
    assert np.all(info.converged)
    F = np.asarray(F, float)
    h = np.asarray(H, dtype)
    assert np.max(residual_norms(F, pi, J, h) / traces(J)) < 4 * eps(dtype)
    np.testing.assert_allclose(
        np.swapaxes(F, 1, 2) @ F, np.eye(3)[None] + 0 * F, rtol=0, atol=8 * eps(dtype)
    )
    np.testing.assert_allclose(np.linalg.det(F), 1, rtol=0, atol=8 * eps(dtype))


def test_F_is_the_root_found_in_exponential_coordinates(dtype):
    pi, J = random_steps(dtype, 0.9, 2)
    h = np.asarray(H, dtype)
    F, _ = solver()(pi, J, jnp.asarray(h), None)
    desired = oracle(pi, J, h)
    # Rounding is amplified by bodies with a small moment and by the vicinity of the fold.
    np.testing.assert_allclose(F, desired, rtol=0, atol=16 * eps(dtype))


@pytest.mark.parametrize("newton_iters", [1, 8])
def test_the_reported_residual_is_that_of_F(dtype, newton_iters):
    pi, J = random_steps(dtype, 1.5, 3)
    h = np.asarray(H, dtype)
    F, info = solver(newton_iters)(pi, J, jnp.asarray(h), None)
    desired = residual_norms(F, pi, J, h)
    assert np.max(desired) > 1e-3  # some are beyond solvability
    error = np.abs(np.asarray(info.residual_norm, float) - desired)
    assert np.max(error / traces(J)) < 4 * eps(dtype)


def test_converged_means_no_greater_than_the_tolerance(dtype):
    pi, J = jnp.asarray([8 * PI0], dtype), jnp.asarray([GENERIC], dtype)
    h = jnp.asarray(H, dtype)
    norm = solver(1)(pi, J, h, jnp.zeros((), dtype))[1].residual_norm[0]
    assert norm > 0
    for tolerance, converged in [(norm, True), (jnp.nextafter(norm, 0 * norm), False)]:
        assert solver(1)(pi, J, h, tolerance)[1].converged[0] == converged


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_do_not_converge_and_do_not_raise(dtype, bad):
    pi = jnp.asarray([[0.1, bad, 0.0], [0.1, 0.2, 0.0]], dtype)
    J = jnp.asarray([GENERIC, GENERIC + bad], dtype)
    for tolerance in (None, jnp.asarray(jnp.inf, dtype)):
        F, info = solver()(pi, J, jnp.asarray(H, dtype), tolerance)
        assert np.all(np.any(np.isnan(F), axis=(1, 2)))
        assert not np.any(info.converged)
        assert not np.any(np.isfinite(info.residual_norm))


def test_a_spin_about_a_principal_axis_can_be_solved_up_to_one(dtype):
    moments, axes = np.linalg.eigh(GENERIC)
    for rate, solvable in [(0.99, True), (1.05, False)]:
        pi = jnp.asarray((moments * axes).T * rate / H, dtype)
        J = jnp.asarray(np.stack([GENERIC] * 3), dtype)
        F, info = solver(16)(pi, J, jnp.asarray(H, dtype), None)
        np.testing.assert_array_equal(info.converged, solvable)
        if solvable:
            F = np.asarray(F, float)
            sine = (F - np.swapaxes(F, 1, 2)) / 2
            # F turns about the axis by asin(h |omega|).
            desired = [hat(rate * axis) for axis in axes.T]
            np.testing.assert_allclose(sine, desired, rtol=0, atol=8 * eps(dtype))


def test_far_beyond_solvability_the_failure_is_reported_and_not_raised(dtype):
    J = physical_inertias(COUNT, 4)
    pi = momenta(J, 5.0, 4, h=H)
    rate = np.linalg.norm(np.linalg.solve(J, H * pi[..., None])[..., 0], axis=1)
    pi, J = jnp.asarray(pi, dtype), jnp.asarray(J, dtype)
    F, info = solver()(pi, J, jnp.asarray(H, dtype), None)
    assert np.count_nonzero(rate > 2) > 50
    assert not np.any(info.converged[rate > 2])
    assert np.all(np.isfinite(info.residual_norm))
    np.testing.assert_allclose(
        np.swapaxes(F, 1, 2) @ F, np.broadcast_to(np.eye(3), F.shape), rtol=0, atol=16 * eps(dtype)
    )


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_degenerate_bodies_at_every_scale(dtype, scale):
    bodies = np.stack([body for body in BODIES.values() for _ in range(30)])
    pi = jnp.asarray(scale * momenta(bodies, 0.99, 7, h=H), dtype)
    J = jnp.asarray(scale * bodies, dtype)
    h = np.asarray(H, dtype)
    F, info = solver()(pi, J, jnp.asarray(h), None)
    assert np.all(info.converged)
    assert np.max(residual_norms(F, pi, J, h) / traces(J)) < 4 * eps(dtype)
    # A rod's smallest moment amplifies rounding up to a millionfold: only its residual is small.
    rod = np.repeat(["rod" in name for name in BODIES], 30)
    desired = oracle(pi[~rod], J[~rod], h)
    np.testing.assert_allclose(F[~rod], desired, rtol=0, atol=20 * eps(dtype))


def test_the_scale_aware_tolerance_is_reached(dtype):
    for largest in (1e-6, 0.1, 0.99):
        pi, J = random_steps(dtype, largest, 8)
        h = jnp.asarray(H, dtype)
        assert np.all(solver()(pi, J, h, None)[1].converged)
        # It is no blank cheque: a residual a hundred times rounding is a failure.
        info = solver(1)(pi, J, h, None)[1]
        angle = np.linalg.norm(np.linalg.solve(J, H * pi[..., None])[..., 0], axis=1)
        poor = np.asarray(info.residual_norm, float) > 100 * eps(dtype) * traces(J) * angle
        assert not np.any(info.converged & poor)
        assert largest < 0.5 or np.any(poor)


@pytest.mark.parametrize("body", ["generic", "rod"])
def test_no_momentum_gives_exactly_the_identity(dtype, body):
    J = jnp.asarray([BODIES[body]], dtype)
    for tolerance in (None, jnp.asarray(1e-10, dtype)):
        F, info = solver()(jnp.zeros((1, 3), dtype), J, jnp.asarray(H, dtype), tolerance)
        np.testing.assert_array_equal(F[0], np.eye(3))
        assert info.residual_norm[0] == 0
        assert info.converged[0]


def test_a_negative_step_undoes_the_step(dtype):
    pi, J = random_steps(dtype, 0.9, 9)
    h = jnp.asarray(H, dtype)
    F, _ = solver()(pi, J, h, None)
    pi_next = jnp.einsum("nji,nj->ni", F, pi)
    F_back, info = solver()(pi_next, J, -h, None)
    assert np.all(info.converged)
    np.testing.assert_allclose(F_back, np.swapaxes(F, 1, 2), rtol=0, atol=32 * eps(dtype))


def test_only_the_symmetric_part_of_the_inertia_enters():
    pi, J = jnp.asarray([PI0]), jnp.asarray([GENERIC])
    skew = jnp.asarray(hat([0.3, -0.2, 0.1]))[None]
    F, _ = solver()(pi, J, jnp.asarray(0.3), None)
    np.testing.assert_allclose(
        solver()(pi, J + skew, jnp.asarray(0.3), None)[0], F, rtol=0, atol=1e-15
    )


def test_solve_F_is_the_first_of_solve_F_with_info():
    pi, J = jnp.asarray([PI0]), jnp.asarray([GENERIC])
    F = jax.jit(jax.vmap(lgvi.solve_F, in_axes=(0, 0, None)))(pi, J, 0.3)
    desired = solver()(pi, J, jnp.asarray(0.3), None)[0]
    # Two programs: the compiler may contract multiplications and additions differently.
    np.testing.assert_allclose(F, desired, rtol=0, atol=4 * eps(jnp.float64))


def test_a_batch_is_a_loop():
    pi, J = random_steps(jnp.float64, 0.9, 10)
    F, info = solver()(pi[:4], J[:4], jnp.asarray(H), None)
    solve = jax.jit(lambda pi, J: lgvi.solve_F_with_info(pi, J, H, tolerance=None))
    for i in range(4):
        F_i, info_i = solve(pi[i], J[i])
        np.testing.assert_allclose(F_i, F[i], rtol=0, atol=1e-14)
        np.testing.assert_allclose(info_i.residual_norm, info.residual_norm[i], rtol=0, atol=1e-15)
        assert info_i.converged == info.converged[i]


@pytest.mark.parametrize("function", [lgvi.solve_F, lgvi.solve_F_with_info])
def test_errors_name_the_argument(unchecked, function):
    good: dict[str, Any] = {"pi": PI0, "J": GENERIC, "h": H}
    for name in good:
        with pytest.raises(ValueError, match=rf"`{name}` must have shape .* shape is \(2,\)"):
            function(**good | {name: np.ones(2)})
        with pytest.raises(TypeError, match=rf"`{name}` must be real"):
            function(**good | {name: 1j * np.asarray(good[name])})
    with pytest.raises(ValueError, match=r"`newton_iters` must be at least 1, but is 0"):
        function(**good, newton_iters=0)
    for bad in (2.5, True):
        with pytest.raises(TypeError, match=r"`newton_iters` must be an integer"):
            function(**good, newton_iters=bad)
    with pytest.raises(TypeError, match=r"`newton_iters` must be .* static under `jax.jit`"):
        jax.jit(lambda n: function(**good, newton_iters=n))(3)


def test_the_tolerance_is_a_scalar(unchecked):
    with pytest.raises(ValueError, match=r"`tolerance` must have shape \(\)"):
        lgvi.solve_F_with_info(PI0, GENERIC, H, tolerance=np.ones(2))


@pytest.mark.parametrize("tolerance", [-1.0, np.nan, jnp.inf, jnp.asarray(-1e-10), "x", True])
def test_the_tolerance_is_not_negative(tolerance, unchecked):
    simulate = partial(lgvi.simulate_free_rigid_body, np.eye(3), PI0, GENERIC, H, 2)
    for call in (simulate, partial(lgvi.solve_F_with_info, PI0, GENERIC, H)):
        for run in (call, jax.jit(lambda call=call: call(tolerance=tolerance))):
            with pytest.raises((TypeError, ValueError), match="`tolerance` must be"):
                run(**({"tolerance": tolerance} if run is call else {}))
