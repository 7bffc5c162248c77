"""Trajectories: order, conservation, reversibility, symmetry, and the forced step."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import ArrayLike

import lgvi

from ..oracle import oracle_step
from ..systems import (
    BODIES,
    GENERIC,
    PI0,
    R0,
    euler_equations,
    momenta,
    physical_inertias,
    rotation,
)

DT = np.asarray(0.1)  # no Python number: programs are compiled anew for those
STEPS = 12
TIMES = DT * np.arange(STEPS + 1)


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


def torque(t):
    """A body-frame torque, of one time or of many."""
    t = np.asarray(t)
    return np.stack([np.cos(3 * t), 0.5 + np.sin(2 * t), np.cos(t) ** 2], axis=-1)


free = jax.jit(
    lambda R0, pi0, J, dt: lgvi.simulate_free_rigid_body(R0, pi0, J, dt, STEPS, tolerance=None)
)
forced = jax.jit(partial(lgvi.simulate_rigid_body, tolerance=None))


def case(dtype=float, dt: ArrayLike = DT):
    return [jnp.asarray(x, dtype) for x in (R0, PI0, GENERIC)], jnp.asarray(dt, dtype)


def test_second_order_with_and_without_torque():
    counts, most = [20, 40, 80, 160], 160
    references = [
        tuple(x[-1] for x in euler_equations(R0, PI0, GENERIC, [0.0, 2.0], law))
        for law in (None, lambda t, R, omega: torque(t))
    ]
    errors, simulate = [], partial(lgvi.simulate_rigid_body, R0, PI0, GENERIC)
    run = jax.jit(jax.vmap(simulate, in_axes=(0, None)))
    for n in counts:  # of one compiled program, which goes on where fewer steps are enough
        times = 2 / n * np.arange(most + 1)
        torques = np.stack([0 * torque(times), torque(times)])
        Rs, pis, info = run(torques, 2 / n)
        assert np.all(info.converged)
        errors.append(
            [
                [np.linalg.norm(R[n] - R_end), np.linalg.norm(pi[n] - pi_end)]
                for R, pi, (R_end, pi_end) in zip(Rs, pis, references, strict=True)
            ]
        )
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    np.testing.assert_allclose(orders, 2.0, rtol=0, atol=0.1)


@pytest.mark.parametrize("body", BODIES)
def test_free_motion_conserves_energy_momentum_and_orthogonality(dtype, body):
    J = BODIES[body]
    pi0 = J @ np.array([3.0, -2.0, 4.0])
    Rs, pis, info = free(*(jnp.asarray(x, dtype) for x in (R0, pi0, J, DT)))
    assert np.all(info.converged)
    Rs, pis = np.asarray(Rs, float), np.asarray(pis, float)
    J = np.asarray(jnp.asarray(J, dtype), float)
    energy = np.einsum("ni,ni->n", pis, np.linalg.solve(J, pis.T).T) / 2
    momentum = np.einsum("nij,nj->ni", Rs, pis)
    # Rounding accumulates over the steps.
    unit = STEPS * eps(dtype)
    if body != "rod":  # a rod's small moment amplifies the rounding of pi in its energy
        np.testing.assert_allclose(energy, energy[0], rtol=2 * unit)
    change = np.linalg.norm(momentum - momentum[0], axis=1)
    assert np.max(change) < unit * np.linalg.norm(pi0)
    np.testing.assert_allclose(
        np.swapaxes(Rs, 1, 2) @ Rs, np.broadcast_to(np.eye(3), Rs.shape), rtol=0, atol=unit
    )
    np.testing.assert_allclose(np.linalg.det(Rs), 1, rtol=0, atol=unit)


def test_the_component_of_momentum_along_the_rodrigues_vector_is_constant():
    (R, pi, J), dt = case()
    Rs, pis, _ = free(R, 3 * pi, J, dt)
    Fs = jnp.swapaxes(Rs[:-1], 1, 2) @ Rs[1:]
    c = jax.jit(jax.vmap(lgvi.so3.cayley_inverse))(Fs)
    along = np.einsum("ni,ni->n", c, pis[:-1])
    np.testing.assert_allclose(along, along[0], rtol=1e-14)


def test_each_step_is_half_impulse_free_step_half_impulse(dtype):
    (R, pi, J), dt = case(dtype)
    torques = jnp.asarray(torque(TIMES), dtype)
    Rs, pis, info = forced(R, pi, J, torques, dt)
    assert Rs.dtype == pis.dtype == info.residual_norm.dtype == dtype
    assert Rs.shape == (STEPS + 1, 3, 3)
    assert pis.shape == (STEPS + 1, 3)
    assert info.converged.shape == info.residual_norm.shape == (STEPS,)
    state = [np.asarray(x, float) for x in (R, pi)]
    for k in range(STEPS + 1):
        np.testing.assert_allclose(Rs[k], state[0], rtol=0, atol=(8 + 4 * k) * eps(dtype))
        np.testing.assert_allclose(pis[k], state[1], rtol=0, atol=(8 + 8 * k) * eps(dtype))
        if k < STEPS:
            pair = np.asarray(torques, float)[k : k + 2]
            state = oracle_step(*state, np.asarray(J, float), *pair, float(dt))


def test_a_trajectory_is_a_loop_of_steps():
    (R, pi, J), _ = case()
    torques, dts = torque(TIMES), np.linspace(0.05, 0.15, STEPS)
    Rs, pis, info = forced(R, pi, J, torques, dts)
    step = jax.jit(partial(lgvi.rigid_body_step, tolerance=None))
    for k in range(STEPS):
        R, pi, info_k = step(R, pi, J, torques[k], torques[k + 1], dts[k])
        np.testing.assert_allclose(R, Rs[k + 1], rtol=0, atol=1e-14)
        np.testing.assert_allclose(pi, pis[k + 1], rtol=0, atol=1e-14)
        assert info_k.converged == info.converged[k]


def test_no_torque_is_free_motion():
    (R, pi, J), dt = case()
    for actual, desired in zip(
        forced(R, pi, J, jnp.zeros((STEPS + 1, 3)), dt)[:2], free(R, pi, J, dt)[:2], strict=True
    ):
        np.testing.assert_allclose(actual, desired, rtol=0, atol=1e-15)


def test_equal_steps_in_an_array_are_a_scalar_step(dtype):
    (R, pi, J), dt = case(dtype)
    many = jnp.full((STEPS,), dt)
    for actual, desired in zip(free(R, pi, J, many)[:2], free(R, pi, J, dt)[:2], strict=True):
        assert actual.dtype == dtype
        np.testing.assert_allclose(actual, desired, rtol=0, atol=4 * eps(dtype))


def test_the_flow_backwards_returns_to_the_start():
    (R, pi, J), _ = case()
    dts, torques = np.linspace(0.05, 0.15, STEPS), torque(TIMES)
    Rs, pis, _ = forced(R, pi, J, torques, dts)
    back_R, back_pi, info = forced(Rs[-1], pis[-1], J, torques[::-1], -dts[::-1])
    assert np.all(info.converged)
    np.testing.assert_allclose(back_R[::-1], Rs, rtol=0, atol=5e-15)
    np.testing.assert_allclose(back_pi[::-1], pis, rtol=0, atol=5e-15)


def test_two_trajectories_compose_to_one():
    (R, pi, J), dt = case()
    torques = torque(TIMES)
    Rs, pis, _ = forced(R, pi, J, torques, dt)
    first = forced(R, pi, J, torques[:7], dt)
    second = forced(first[0][-1], first[1][-1], J, torques[6:], dt)
    np.testing.assert_allclose(jnp.concatenate([first[0], second[0][1:]]), Rs, rtol=0, atol=1e-14)
    np.testing.assert_allclose(jnp.concatenate([first[1], second[1][1:]]), pis, rtol=0, atol=1e-14)


def test_no_steps_return_the_initial_state(dtype):
    (R, pi, J), dt = case(dtype)
    runs = [
        lgvi.simulate_free_rigid_body(R, pi, J, dt, 0),
        lgvi.simulate_rigid_body(R, pi, J, jnp.zeros((1, 3), dtype), dt),
        lgvi.simulate_free_rigid_body(R, pi, J, jnp.zeros((0,), dtype), 0),
    ]
    for Rs, pis, info in runs:
        np.testing.assert_array_equal(Rs, R[None])
        np.testing.assert_array_equal(pis, pi[None])
        assert info.converged.shape == (0,)


def test_turning_space_turns_every_attitude():
    (R, pi, J), dt = case()
    torques, Q = torque(TIMES), rotation(20)
    Rs, pis, _ = forced(R, pi, J, torques, dt)
    Rs_turned, pis_turned, _ = forced(Q @ R0, pi, J, torques, dt)
    np.testing.assert_allclose(Rs_turned, Q @ np.asarray(Rs), rtol=0, atol=1e-14)
    np.testing.assert_allclose(pis_turned, pis, rtol=0, atol=1e-14)


def test_changing_the_body_axes_changes_the_coordinates_only():
    torques, Q = torque(TIMES), rotation(21)
    Rs, pis, _ = forced(R0, PI0, GENERIC, torques, DT)
    Rs_turned, pis_turned, _ = forced(R0 @ Q.T, Q @ PI0, Q @ GENERIC @ Q.T, torques @ Q.T, DT)
    np.testing.assert_allclose(Rs_turned @ Q, Rs, rtol=0, atol=1e-14)
    np.testing.assert_allclose(pis_turned @ Q, pis, rtol=0, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_scaling_inertia_momentum_and_torque_leaves_the_attitudes(dtype, scale):
    (R, pi, J), dt = case(dtype)
    torques = jnp.asarray(torque(TIMES), dtype)
    Rs, pis, _ = forced(R, pi, J, torques, dt)
    Rs_scaled, pis_scaled, info = forced(R, scale * pi, scale * J, scale * torques, dt)
    assert np.all(info.converged)
    np.testing.assert_allclose(Rs_scaled, Rs, rtol=0, atol=20 * eps(dtype))
    np.testing.assert_allclose(pis_scaled / scale, pis, rtol=0, atol=20 * eps(dtype))


def test_a_batch_of_states_and_inertias_is_a_loop():
    Js = physical_inertias(3, 22)
    pis = momenta(Js, 0.6, 22, h=float(DT))
    Rs = np.stack([rotation(22, i) for i in range(3)])
    batch = jax.jit(jax.vmap(lambda R, pi, J: lgvi.simulate_free_rigid_body(R, pi, J, DT, STEPS)))(
        Rs, pis, Js
    )
    for i in range(3):
        R_i, pi_i, _ = free(Rs[i], pis[i], Js[i], DT)
        np.testing.assert_allclose(R_i, batch[0][i], rtol=0, atol=1e-14)
        np.testing.assert_allclose(pi_i, batch[1][i], rtol=0, atol=1e-14)


def test_a_step_that_cannot_be_solved_is_flagged_where_it_happens(dtype):
    dts = np.full(STEPS, DT)
    dts[5] = 2.0
    (R, pi, J), dts = case(dtype, dts)
    Rs, _, info = forced(R, pi, J, jnp.asarray(torque(TIMES), dtype), dts)
    np.testing.assert_array_equal(info.converged, np.arange(STEPS) != 5)
    assert np.all(np.isfinite(Rs))


def test_a_step_to_a_state_that_is_not_finite_has_not_converged():
    none = np.zeros(3)
    given = {"R": R0, "pi": PI0, "J": GENERIC, "torque_k": none, "torque_next": none, "dt": DT}
    step = jax.jit(partial(lgvi.rigid_body_step, tolerance=None))
    assert step(**given)[2].converged
    for name in given:
        assert not step(**given | {name: np.nan * given[name]})[2].converged, name


def test_errors_name_the_argument(unchecked):
    good: dict[str, Any] = {"R0": R0, "pi0": PI0, "J": GENERIC, "dt": DT}
    many: dict[str, Any] = good | {"dt": np.ones(4)}
    bad: dict[str, Any]
    for name in ("R0", "pi0", "J"):
        for run in (
            partial(lgvi.simulate_free_rigid_body, steps=3),
            partial(lgvi.simulate_rigid_body, body_torques=np.zeros((4, 3))),
        ):
            bad = good | {name: np.ones(2)}
            with pytest.raises(ValueError, match=rf"`{name}` must have shape .* is \(2,\)"):
                run(**bad)
            with pytest.raises(ValueError, match=r"`dt` must have shape \(\) or \(3,\)"):
                run(**many)
    with pytest.raises(ValueError, match=r"`steps` must be at least 0, but is -1"):
        lgvi.simulate_free_rigid_body(**good, steps=-1)
    with pytest.raises(TypeError, match=r"`steps` must be .* static under `jax.jit`"):
        jax.jit(lambda n: lgvi.simulate_free_rigid_body(**good, steps=n))(3)
    for torques in (np.zeros(3), np.zeros((0, 3))):
        with pytest.raises(ValueError, match=r"`body_torques` must have shape \(steps\+1, 3\)"):
            lgvi.simulate_rigid_body(**good, body_torques=torques)
    with pytest.raises(ValueError, match=r"`body_torques` must have shape \(4, 3\)"):
        lgvi.simulate_rigid_body(**good, body_torques=np.zeros((4, 2)))
    step: dict[str, Any] = {"R": R0, "pi": PI0, "J": GENERIC, "dt": DT}
    step |= {"torque_k": PI0, "torque_next": PI0}
    for name in step:
        bad = step | {name: np.ones(2)}
        with pytest.raises(ValueError, match=rf"`{name}` must have shape"):
            lgvi.rigid_body_step(**bad)
