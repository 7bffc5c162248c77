"""What JAX and Python do with programs and objects, for free, forced and law-driven motion."""

import pickle
import subprocess
import sys
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import lgvi

from ..systems import GENERIC, PI0, R0, rng

STEPS = 4
INTEGRATOR = lgvi.MoserVeselovIntegrator(0.1, throw=False)
BODY = lgvi.RigidBody(GENERIC)
TORQUES = np.full((STEPS + 1, 3), 0.1)


def free(pi0):
    integrator = lgvi.MoserVeselovIntegrator(0.1, throw=False, order=8)
    return integrator.simulate(BODY, R0, pi0, steps=STEPS).R


def forced(pi0):
    return INTEGRATOR.simulate(BODY, R0, pi0, body_torques=TORQUES).R


def driven(pi0):
    torque = lgvi.UniformGravity(0.3, np.array([0.0, 0.0, 0.1]))
    return INTEGRATOR.simulate(BODY, R0, pi0, steps=STEPS, torque=torque).R


MOTIONS = free, forced, driven


# Checking for leaks takes long, as it traces all anew.
@pytest.mark.parametrize(
    "motion", [pytest.param(m, marks=pytest.mark.slow if m is not driven else ()) for m in MOTIONS]
)
def test_transformations_leak_nothing_and_agree(motion):
    def last(pi0):
        return jnp.sum(motion(pi0)[-1] * jnp.arange(9.0).reshape(3, 3))

    def derivatives(pi0):
        gradient = jax.grad(jax.checkpoint(last))
        _, change = jax.jvp(gradient, (pi0,), (jnp.ones(3),))
        return jax.grad(last)(pi0), gradient(pi0), jax.hessian(last)(pi0), change

    with jax.checking_leaks(), jax.debug_nans(True):
        plain, recomputed, hessian, change = jax.jit(derivatives)(PI0)
    np.testing.assert_allclose(recomputed, plain, rtol=1e-12)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(jnp.sum(hessian, axis=1), change, rtol=1e-9, atol=1e-11)
    assert np.max(np.abs(change)) > 1e-2


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.filterwarnings("ignore:Some donated buffers were not usable")
def test_programs_are_exported_and_take_donated_arrays(motion):
    program = jax.jit(motion, donate_argnums=0)
    given = jax.ShapeDtypeStruct((3,), jnp.float64)
    restored = jax.export.deserialize(jax.export.export(program)(given).serialize())
    expected = program(jnp.asarray(PI0))
    np.testing.assert_array_equal(restored.call(jnp.asarray(PI0)), expected)


def test_modules_are_pickled():
    law = lgvi.UniformGravity(0.3, np.array([0.0, 0.0, 0.1])) + lgvi.LinearDamping(np.eye(3))
    modules = (
        INTEGRATOR,
        BODY,
        lgvi.PhysicalRigidBody.from_inertia(GENERIC),
        lgvi.Gyrostat(GENERIC, np.ones(3)),
        law,
        lgvi.Trajectory(
            jnp.eye(3)[None],
            jnp.ones((1, 3)),
            lgvi.SolverInfo(*2 * [jnp.ones(0)]),
            jnp.ones(1),
        ),
    )
    for module in modules:
        assert eqx.tree_equal(pickle.loads(pickle.dumps(module)), module)


class Thrown(eqx.Module):
    body: lgvi.PhysicalRigidBody
    integrator: lgvi.MoserVeselovIntegrator
    pi0: jax.Array

    def compute_loss(self):
        """Mean over the states before a step fails, and their number for each trajectory."""

        @jax.checkpoint
        def of_one(pi0):
            R, _, info = self.integrator.simulate(self.body, R0, pi0)
            good = jnp.cumsum(~info.converged) == 0
            return jnp.sum(jnp.where(good, R[1:, 0, 1], 0.0)), jnp.sum(good)

        sums, counts = jax.vmap(of_one)(self.pi0)
        return jnp.sum(sums) / jnp.sum(counts).astype(float), counts


@eqx.filter_jit
def train(learned, fixed):
    optimiser = optax.adamw(1e-3, weight_decay=0.1)

    @partial(eqx.filter_value_and_grad, has_aux=True)
    def loss(learned):
        return eqx.combine(learned, fixed).compute_loss()

    def update(state, _):
        learned, memory = state
        (value, counts), gradient = loss(learned)
        updates, memory = optimiser.update(gradient, memory, learned)
        return (eqx.apply_updates(learned, updates), memory), (value, counts, gradient)

    (learned, _), steps = jax.lax.scan(update, (learned, optimiser.init(learned)), length=2)
    return learned, *steps


@jax.numpy_dtype_promotion("standard")  # Optax mixes types
def test_training_leaves_out_failed_steps_and_what_is_frozen():
    """With the derivative of all that is before a failed step."""
    dt = np.array([0.1, 0.1, 0.1, 1.6, 0.1])
    axis = np.linalg.eigh(GENERIC)[1][:, 1] + 0.1
    integrator = lgvi.MoserVeselovIntegrator(dt, throw=False)
    body = lgvi.PhysicalRigidBody.from_inertia(GENERIC)
    pi0 = jnp.asarray(np.outer([0.3, 1.0, 20.0], GENERIC @ axis))
    model = Thrown(body, integrator, pi0)
    learned, fixed = lgvi.freeze(model, lambda model: model.integrator.dt)
    trained, values, counts, gradients = train(learned, fixed)
    np.testing.assert_array_equal(counts[0], [5, 3, 0])

    np.testing.assert_array_equal(eqx.combine(trained, fixed).integrator.dt, dt)
    assert np.all(np.asarray(trained.body.log_cholesky) != body.log_cholesky)
    assert values[1] < values[0]
    gradient = jax.tree.map(lambda leaf: leaf[0], gradients)
    np.testing.assert_array_equal(gradient.pi0[2], np.zeros(3))
    size = 1e-5
    direction = jax.tree.map(lambda leaf: rng(241).normal(size=leaf.shape), learned)
    ahead, behind = (
        train(jax.tree.map(lambda x, d, by=by: x + by * d, learned, direction), fixed)[1][0]
        for by in (size, -size)
    )
    products = jax.tree.map(jnp.vdot, gradient, direction)
    along = sum(jax.tree.leaves(products))
    assert abs(along) > 1e-2
    np.testing.assert_allclose((ahead - behind) / (2 * size), along, rtol=1e-8)


def test_what_is_not_a_part_of_a_model_is_refused(unchecked):
    wrong: Any = lambda body: body.inertia + 1, lambda body: body.nothing, "inertia"
    for where in wrong:
        with pytest.raises((TypeError, ValueError), match="Argument `where` must"):
            lgvi.freeze(BODY, where)


PROCESSES = """
import multiprocessing
import sys

import lgvi


def last(pi):
    import jax

    R, _, _ = lgvi.simulate_free_rigid_body(jax.numpy.eye(3), pi, jax.numpy.eye(3), 0.1, 3)
    return float(R[-1, 0, 1])


if __name__ == "__main__":
    # A child by `fork` may use JAX if its parent, which has imported the library, has not yet.
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(1) as pool:
            print(pool.map(last, [[0.1, 0.2, 0.3]])[0])
    print(last([0.1, 0.2, 0.3]))
"""


@pytest.mark.slow
def test_processes_by_fork_and_by_spawn(tmp_path):
    script = tmp_path / "processes.py"
    script.write_text(PROCESSES)
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=300, check=True
    )
    first, second, third = done.stdout.split()
    assert first == second == third
