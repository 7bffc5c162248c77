"""The Newton iteration of a step: its budget, its guess, its damping."""

import jax.numpy as jnp
import numpy as np

from lgvi.core.kernels.vectors import Mat3, Vec3
from lgvi.core.step.equation import residual_norm, with_rotors
from lgvi.core.step.newton import iterate_undamped, third_order_guess

from ...systems import hat, momenta, physical_inertias
from ..steps import COUNT, H, random_steps, residual_norms, solver, traces


def test_the_newton_budget_is_honoured():
    J = jnp.asarray(physical_inertias(COUNT, 5))
    omega = np.linalg.solve(J, momenta(np.asarray(J), 1.0, 5)[..., None])[..., 0]
    omega *= 0.9 / H / np.linalg.norm(omega, axis=1, keepdims=True)
    pi = jnp.einsum("nij,nj->ni", J, omega)
    h = jnp.asarray(H)
    norms = [np.array(solver(n)(pi, J, h, None)[1].residual_norm) / traces(J) for n in (1, 2, 8)]
    assert np.all(norms[0] > 1e-5)
    assert np.all(norms[1] < norms[0])
    assert np.median(norms[1]) > 1e-9
    assert np.all(norms[2] < 1e-14)


def test_a_larger_budget_changes_nothing_once_the_solver_has_stopped(dtype):
    pi, J = random_steps(dtype, 0.99, 6)
    h = jnp.asarray(H, dtype)
    F, info = solver(32)(pi, J, h, None)
    F_more, info_more = solver(1000)(pi, J, h, None)
    np.testing.assert_array_equal(F, F_more)
    np.testing.assert_array_equal(info.residual_norm, info_more.residual_norm)


def test_the_guess_is_of_third_order():
    # The equation is quadratic: Newton's step leaves d (d.p)/2 of an error d of the guess.
    # After a third-order guess d is of order 4 and, its leading term being normal to p, d.p of
    # order 6. A second-order guess would leave 3 + 4 = 7.
    pi, J = random_steps(float, 0.25, 20)
    twice_J = 2 * Mat3.of(J)

    def after_one_step(pi):
        p = Vec3.of(H * pi)
        momentum = with_rotors(p)
        guess = third_order_guess(twice_J.inverse(), momentum)
        c, _ = iterate_undamped(twice_J, momentum, guess, 1, materialise_residual=True)
        return np.asarray(residual_norm(twice_J, p, c))

    coarse, fine = after_one_step(pi), after_one_step(pi / 2)
    measurable = fine > 1e-14 * traces(J)
    assert np.count_nonzero(measurable) > 20
    order = np.median(np.log2(coarse[measurable] / fine[measurable]))
    assert abs(order - 10) < 0.5


def test_each_iteration_keeps_the_best_of_the_documented_damping_factors():
    """Beyond solvability too, where every factor is the best one for some steps."""
    J = physical_inertias(COUNT, 21)
    pi = momenta(J, 3.0, 21, h=H)
    h = jnp.asarray(H)
    F, _ = solver(1)(pi, J, h, None)
    # Rodrigues vector c of F, and Newton's step for J c = (p - c x p + c (c.p))/2.
    factors, best = np.array([0, 0.25, 0.5, 1]), []
    for F_i, p, J_i in zip(np.asarray(F), H * pi, J, strict=True):
        S = F_i - F_i.T
        c = np.array([S[2, 1], S[0, 2], S[1, 0]]) / (1 + np.trace(F_i))
        value = J_i @ c - (p - np.cross(c, p) + c * (c @ p)) / 2
        slope = J_i - (hat(p) + (c @ p) * np.eye(3) + np.outer(c, p)) / 2
        trials = c - factors[:, None] * np.linalg.solve(slope, value)
        turns = [np.linalg.solve(np.eye(3) - hat(c), np.eye(3) + hat(c)) for c in trials]
        best.append(residual_norms(turns, [p] * 4, [J_i] * 4, 1.0))
    best = np.array(best)
    following = solver(2)(pi, J, h, None)[1].residual_norm
    np.testing.assert_allclose(following / traces(J), best.min(1) / traces(J), rtol=0, atol=1e-13)
    assert set(best.argmin(1)) == {0, 1, 2, 3}
