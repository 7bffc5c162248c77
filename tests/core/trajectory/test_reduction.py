"""The fast loop over a trajectory, its fallback, and the single step give the same motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ...systems import GENERIC, R0, TILTED_ROD, rng

STEPS = 12
simulate_free = jax.jit(lgvi.simulate_free_rigid_body, static_argnames="steps")


def loop(J, pi, torques, dt, newton_iters):
    """Step after step, each solved by itself."""
    step = jax.jit(lgvi.rigid_body_step, static_argnames="newton_iters")
    R, Rs, pis = jnp.asarray(R0), [R0], [pi]
    for k in range(STEPS):
        R, pi, _ = step(R, pi, J, torques[k], torques[k + 1], dt[k], newton_iters=newton_iters)
        Rs.append(R)
        pis.append(pi)
    return np.stack(Rs), np.stack(pis)


@pytest.mark.parametrize("body", [GENERIC, TILTED_ROD], ids=["generic", "tilted rod"])
# Two undamped iterations suffice up to about 0.25 and four up to about 0.9; neither is taken
# with a budget of one, which is not enough beyond 0.1.
@pytest.mark.parametrize(
    ("rotation", "newton_iters"),
    [
        (0.01, 1),
        pytest.param(0.05, 2, marks=pytest.mark.slow),
        (0.05, 8),
        (0.45, 1),
        (0.45, 8),
        (0.85, 8),
        pytest.param(0.95, 20, marks=pytest.mark.slow),
    ],
)
def test_a_trajectory_is_its_steps(body, rotation, newton_iters):
    random = rng(61)
    direction = random.normal(size=3)
    pi0 = jnp.asarray(body @ direction * rotation / np.linalg.norm(direction))
    dt = jnp.asarray(random.uniform(0.5, 1.0, STEPS))
    torques = jnp.asarray(1e-3 * random.normal(size=(STEPS + 1, 3)) @ body)
    J = jnp.asarray(body)
    Rs, pis, info = lgvi.simulate_rigid_body(R0, pi0, J, torques, dt, newton_iters, None)
    assert np.all(info.converged) == ((rotation, newton_iters) != (0.45, 1))
    desired_R, desired_pi = loop(J, pi0, torques, dt, newton_iters)
    # By the ratio of the moments, and by a step near its limit: of a sphere h|omega| = sin(angle).
    amplification = (1 if body is GENERIC else 1e4) / np.sqrt(1 - rotation**2)
    np.testing.assert_allclose(Rs, desired_R, rtol=0, atol=2e-14 * amplification)
    size = np.linalg.norm(pis, axis=1).max()
    np.testing.assert_allclose(pis, desired_pi, rtol=0, atol=1e-14 * size * amplification)


def test_one_trajectory_of_a_batch_that_needs_the_fallback_changes_no_other():
    pi0s = np.outer([0.1, 1.0, 0.3], GENERIC @ np.array([0.1, 0.9, 0.2]))

    def simulate(pi0):
        return lgvi.simulate_free_rigid_body(R0, pi0, jnp.asarray(GENERIC), 1.0, STEPS)

    batch = jax.jit(jax.vmap(simulate))(pi0s)
    for i, pi0 in enumerate(pi0s):
        for batched, single in zip(
            jax.tree.leaves(batch), jax.tree.leaves(simulate(pi0)), strict=True
        ):
            size = max(1, np.max(np.abs(single)))
            np.testing.assert_allclose(batched[i], single, rtol=0, atol=1e-14 * size)


# A little short of what two undamped iterations suffice for, and four: what they leave has the
# same sign in all steps.
@pytest.mark.parametrize("rotation", [0.34, 0.38, 0.98])
def test_energy_does_not_drift(rotation):
    direction = np.array([0.68, 0.57, -0.46])
    pi0 = jnp.asarray(GENERIC @ direction * rotation / np.linalg.norm(direction))
    _, pis, info = simulate_free(R0, pi0, GENERIC, 1.0, steps=50_000)
    assert np.all(info.converged)
    energy = np.einsum("ni,ni->n", pis, np.linalg.solve(GENERIC, pis.T).T)
    np.testing.assert_allclose(energy, energy[0], rtol=5e-13)


def test_orthogonality_does_not_drift():
    pi0 = jnp.asarray(GENERIC @ np.array([0.3, 0.2, 0.4]))
    Rs = np.asarray(simulate_free(np.eye(3), pi0, GENERIC, 0.5, steps=50_000)[0])
    errors = np.linalg.norm(np.swapaxes(Rs, 1, 2) @ Rs - np.eye(3), axis=(1, 2))
    # A product of matrices is at 5e-14 by then.
    assert np.max(errors) < 4e-15


@pytest.mark.parametrize("rotation", [0.2, 0.6, 0.9])
def test_a_step_beyond_the_limit_is_reported_at_exactly_that_step(rotation):
    steps, bad = 3000, 1234
    axis = np.linalg.eigh(GENERIC)[1][:, 1]
    dt = np.full(steps, rotation)
    dt[bad] = 1.3  # the body spins at 1 rad/s; there is no solution from 1 on
    _, _, info = lgvi.simulate_free_rigid_body(R0, GENERIC @ axis, GENERIC, dt, steps, 20, None)
    np.testing.assert_array_equal(np.flatnonzero(~info.converged), [bad])


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="about the compiler for the CPU")
@pytest.mark.parametrize(
    "case",
    [
        pytest.param("free", marks=pytest.mark.slow),
        "torques",
        pytest.param("an inertia for each step", marks=pytest.mark.slow),
        "rotors",
    ],
)
def test_the_loops_of_a_trajectory_are_compiled_whole(case):
    steps = 1000

    def simulate(pi0, dt, body_torques):
        arguments = jnp.eye(3), pi0, jnp.asarray(GENERIC)
        if case == "torques":
            return lgvi.simulate_rigid_body(*arguments, body_torques, dt)
        if case == "rotors":
            body = lgvi.Gyrostat(GENERIC, body_torques[1:])
            return lgvi.MoserVeselovIntegrator(dt, throw=False).simulate(body, *arguments[:2])
        dt, order = (dt[0], 2) if case == "free" else (dt, 6)
        return lgvi.simulate_free_rigid_body(*arguments, dt, steps, order=order)

    def gradient(*arguments):
        return jax.grad(lambda *x: jnp.sum(simulate(*x)[0][:, 0]))(*arguments)

    arguments = jnp.ones(3), jnp.full(steps, 0.1), jnp.ones((steps + 1, 3))
    text = jax.jit(gradient).lower(*arguments).compile().as_text()
    # A loop that is not compiled whole dispatches every operation and runs ten times slower.
    assert text is not None
    calls = [line for line in text.splitlines() if 'xla_cpu_small_call="true"' in line]
    # The loop over the momentum, the one over the attitudes, and that over their adjoint variables.
    loops = (
        "/cond/branch_1_fun/while",
        "jit(solve_prescribed)/while",
        "jit(propagate_adjoint)/while",
    )
    assert [sum(f'{loop}"' in line for line in calls) for loop in loops] == [1, 1, 1]
