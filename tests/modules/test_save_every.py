"""Trajectories of which only some states are stored."""

import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.core.trajectory import chunks

from ..core.steps import step_after_step
from ..systems import GENERIC, PI0, R0, rng

CHUNK = 30
# With pieces of 30 steps: several stored states in a piece that they fill, and in pieces that
# they do not fill; several pieces from a stored state to the next, filled and not.
PADDED = 182
FILLED = [pytest.param(*case, marks=pytest.mark.slow) for case in ((120, 10), (240, 60))]
CASES = [(PADDED, 7), (PADDED, 91), *FILLED]
RAISED = (RuntimeError, ValueError)


@pytest.fixture(autouse=True)
def short_chunks(set_chunk_sizes):
    set_chunk_sizes(chunk=CHUNK)


@pytest.mark.parametrize("save_every", [1, 2, 7, 29, 30, 31, 60, 71, 1000])
@pytest.mark.parametrize("stored", [31, 32, 43, 200])
def test_every_step_is_in_one_piece(stored, save_every, set_chunk_sizes):
    set_chunk_sizes(chunk=CHUNK, long=1)
    layout = chunks.choose_chunks(stored * save_every, save_every)
    assert layout is not None
    assert layout.length <= CHUNK
    group, piece = np.indices((layout.groups, layout.of_group)).reshape(2, -1)
    real = zip(*layout.first_and_count(group, piece), strict=True)
    steps = np.concatenate([np.arange(first, first + count) for first, count in real])
    np.testing.assert_array_equal(steps, np.arange(stored * save_every))
    # A group ends with a stored state, and so does each equal part of its last piece.
    assert layout.of_group == 1 or layout.by_group == 1
    assert layout.groups * layout.by_group >= stored > (layout.groups - 1) * layout.by_group
    assert layout.length % layout.by_group == 0
    # Steps of size zero: at most one for each piece, where all states are stored.
    assert layout.of_group * layout.length < layout.by_group * save_every + layout.of_group


def simulate(dt, J, pi0, torques, steps, save_every, **settings):
    integrator = lgvi.MoserVeselovIntegrator(dt, **settings)
    return integrator.simulate(
        lgvi.RigidBody(J),
        jnp.asarray(R0, pi0.dtype),
        pi0,
        steps=steps,
        body_torques=torques,
        save_every=save_every,
    )


def scalar(stride, weight, dt, J, pi0, torques):
    """Of the states of a trajectory of which every `stride`-th is stored."""
    trajectory = simulate(dt, J, pi0, torques, PADDED, stride)
    return jnp.sum(weight[::stride] * trajectory.R), trajectory


with_derivatives = jax.jit(
    jax.value_and_grad(scalar, argnums=(2, 3, 4, 5), has_aux=True), static_argnums=0
)


def padded_case(save_every):
    """Weights of what is stored, and torques and array steps where pieces are not filled."""
    random = rng(80)
    dt = random.uniform(0.02, 0.05, PADDED)
    torques = random.normal(size=(PADDED + 1, 3))
    weight = np.zeros((PADDED + 1, 3, 3))
    weight[::save_every] = random.normal(size=weight[::save_every].shape)
    return [jnp.asarray(x) for x in (weight, dt, GENERIC, PI0, torques)]


@pytest.mark.parametrize(("steps", "save_every"), CASES)
def test_states_and_derivatives_are_those_of_all_steps(steps, save_every):
    padded, results = steps == PADDED, []
    if padded:
        # The program for all steps serves each of the cases.
        results = [with_derivatives(stride, *padded_case(save_every)) for stride in (save_every, 1)]
        some, every = [result[0][1] for result in results]
    else:
        given = jnp.asarray(0.05), jnp.asarray(GENERIC), jnp.asarray(PI0), None
        some, every = (simulate(*given, steps, stride) for stride in (save_every, 1))
    np.testing.assert_allclose(some.R, every.R[::save_every], rtol=0, atol=1e-12)
    np.testing.assert_allclose(some.pi, every.pi[::save_every], rtol=0, atol=1e-12)
    norms = np.reshape(every.solver_info.residual_norm, (-1, save_every)).max(axis=1)
    np.testing.assert_allclose(some.solver_info.residual_norm, norms, rtol=0, atol=1e-15)
    assert np.all(some.solver_info.converged)

    if not padded:
        return
    for actual, desired in zip(*(result[1] for result in results), strict=True):
        size = np.max(np.abs(desired))
        np.testing.assert_allclose(actual / size, desired / size, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("steps", "save_every"), CASES)
def test_the_first_failure_is_named_by_its_step_and_all_are_reported(steps, save_every):
    bad, worse = steps // 2 + 3, steps - 2  # in different pieces and between different states
    axis = np.linalg.eigh(GENERIC)[1][:, 1]
    pi0 = jnp.asarray(GENERIC @ axis)
    dt = np.full(steps, 0.2)
    dt[[bad, worse]] = 1.6, 1.8
    dt, J = jnp.asarray(dt), jnp.asarray(GENERIC)
    info = simulate(dt, J, pi0, None, steps, save_every, throw=False).solver_info
    failed = sorted({bad // save_every, worse // save_every})
    np.testing.assert_array_equal(np.flatnonzero(~info.converged), failed)
    assert info.residual_norm[failed[-1]] > info.residual_norm[failed[0]] or len(failed) == 1
    with pytest.raises(RAISED, match=rf"Step {bad} did not converge: .* pi\| is 1.6,"):
        simulate(dt, J, pi0, None, steps, save_every)


def test_a_last_torque_that_is_not_finite_is_reported():
    """Also where steps of size zero follow in its piece."""
    torques = np.zeros((PADDED + 1, 3))
    torques[-1] = np.nan
    dt = jnp.full(PADDED, 0.05)
    given = dt, jnp.asarray(GENERIC), jnp.asarray(PI0), jnp.asarray(torques), PADDED
    info = simulate(*given, 7, throw=False).solver_info
    np.testing.assert_array_equal(info.converged, np.arange(PADDED // 7) < PADDED // 7 - 1)


def test_a_long_trajectory_is_its_steps(set_chunk_sizes):
    _, dt, J, pi0, torques = padded_case(1)
    set_chunk_sizes(chunk=CHUNK, long=PADDED)
    Rs, pis, info = simulate(dt, J, pi0, torques, PADDED, 1)
    assert info.converged.shape == (PADDED,)

    desired = step_after_step(jnp.asarray(R0), pi0, J, torques, dt)
    np.testing.assert_allclose(Rs[1:], desired[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(pis[1:], desired[1], rtol=0, atol=1e-13)


def test_orthogonality_does_not_drift_from_piece_to_piece():
    steps = 30_000
    pi0, J = jnp.asarray(GENERIC @ np.array([0.3, 0.2, 0.4])), jnp.asarray(GENERIC)
    Rs = simulate(jnp.asarray(0.5), J, pi0, None, steps, 15).R
    Rs = np.asarray(Rs)
    errors = np.linalg.norm(np.swapaxes(Rs, 1, 2) @ Rs - np.eye(3), axis=(1, 2))
    # A product of matrices is at 8e-14 by then.
    assert np.max(errors) < 6e-15


@pytest.mark.slow
def test_memory_is_that_of_what_is_stored():
    def scalar(steps, pi0):
        dt, J = jnp.asarray(0.05), jnp.asarray(GENERIC)
        return jnp.sum(simulate(dt, J, pi0, None, steps, steps // 4, throw=False).R)

    def memory(steps):
        gradient = jax.jit(jax.grad(partial(scalar, steps)))
        program = gradient.lower(jnp.asarray(PI0)).compile()
        analysis = program.memory_analysis()
        assert analysis is not None
        return analysis.temp_size_in_bytes

    # One state for each piece: 16 numbers instead of those of its 30 steps.
    few, many = 80 * CHUNK, 800 * CHUNK
    assert memory(many) - memory(few) < 8 * 32 * (many - few) / CHUNK


def test_a_batch_is_a_loop():
    weight, dt, J, pi0, torques = padded_case(7)
    pi0s = jnp.asarray(np.outer([0.5, 1.0], pi0))

    def run(pi0):
        (_, trajectory), gradients = with_derivatives(7, weight, dt, J, pi0, torques)
        return trajectory, gradients[2]

    batch = jax.jit(jax.vmap(run))(pi0s)
    for i in range(2):
        single = run(pi0s[i])
        for actual, desired in zip(jax.tree.leaves(batch), jax.tree.leaves(single), strict=True):
            np.testing.assert_allclose(actual[i], desired, rtol=0, atol=1e-11)


def test_one_failure_in_a_batch_raises():
    def last(pi0):
        dt, J = jnp.asarray(1.0), jnp.asarray(GENERIC)
        return simulate(dt, J, pi0, None, 91, 7).R[-1]

    axis = GENERIC @ np.linalg.eigh(GENERIC)[1][:, 1]
    slow, fast = 0.2 * axis, 1.6 * axis
    with pytest.raises(RAISED, match="a step did not converge"):
        jax.block_until_ready(jax.jit(jax.vmap(last))(jnp.asarray([slow, fast])))


def test_backwards_undoes_forwards_and_keeps_the_precision(dtype):
    dt, J, pi0 = (jnp.asarray(x, dtype) for x in (0.05, GENERIC, PI0))
    there = simulate(dt, J, pi0, None, 91, 7)
    assert there.R.dtype == there.pi.dtype == there.solver_info.residual_norm.dtype == dtype
    integrator = lgvi.MoserVeselovIntegrator(-dt)
    back = integrator.simulate(lgvi.RigidBody(J), there.R[-1], there.pi[-1], steps=91, save_every=7)
    unit = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(back.R[::-1], there.R, rtol=0, atol=300 * unit)
    np.testing.assert_allclose(back.pi[::-1], there.pi, rtol=0, atol=300 * unit)


def test_what_is_not_a_number_is_not_lost():
    dt = jnp.full(PADDED, 0.05).at[30].set(jnp.nan)
    given = dt, jnp.asarray(GENERIC), jnp.asarray(PI0), None, PADDED, 7
    lenient = simulate(*given, throw=False)
    np.testing.assert_array_equal(lenient.solver_info.converged, np.arange(26) < 4)
    with pytest.raises(RAISED, match="Step 30 did not converge"):
        simulate(*given)


def test_a_short_trajectory_is_thinned():
    dt, J, pi0 = jnp.asarray(0.05), jnp.asarray(GENERIC), jnp.asarray(PI0)
    some, every = (simulate(dt, J, pi0, None, 12, k) for k in (4, 1))
    np.testing.assert_allclose(some.R, every.R[::4], rtol=0, atol=1e-15)
    assert some.solver_info.converged.shape == (3,)
    none = simulate(dt, J, pi0, None, 0, 4)
    np.testing.assert_array_equal(none.R, R0[None])


def test_more_states_than_the_memory_holds_are_refused(monkeypatch):
    monkeypatch.setattr(os, "sysconf", lambda name: 2**15)  # 1 GiB, in pages

    def run(steps, save_every):
        method = lgvi.MoserVeselovIntegrator(0.1)
        return method.simulate(lgvi.RigidBody(GENERIC), R0, PI0, steps=steps, save_every=save_every)

    many = 2**31 - 2**20
    message = r"`steps` must store states that fit in the memory of 1 GiB, .*`save_every`"
    with pytest.raises(ValueError, match=message):
        run(many, 1)
    assert jax.eval_shape(lambda: run(many, 2**20)).pi.shape == (2**11, 3)
    with pytest.raises(ValueError, match=r"`steps` must be below 2\*\*31, but is 1099511627776"):
        run(2**40, 2**20)


def test_what_does_not_divide_the_steps_is_refused():
    dt, J, pi0 = jnp.asarray(0.05), jnp.asarray(GENERIC), jnp.asarray(PI0)
    for save_every in (5, 13):
        with pytest.raises(ValueError, match=rf"which is 12, but is {save_every}"):
            simulate(dt, J, pi0, None, 12, save_every)
    with pytest.raises(ValueError, match="`save_every` must be at least 1, but is 0"):
        simulate(dt, J, pi0, None, 12, 0)
