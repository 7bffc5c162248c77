"""A step that cannot be solved: raised with its values in every context, or reported."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0

# Once a call has succeeded, `jax.jit` turns errors of the running program into ValueError.
RAISED = (RuntimeError, ValueError)

STEPS = 6
BAD = 3  # the step made too long
RATE = 2.0  # rad/s, about a principal axis
BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
AXIS = np.linalg.eigh(GENERIC)[1][:, 1]
PI0 = RATE * GENERIC @ AXIS
MESSAGE = (
    rf"Step {BAD} did not converge: .* residual is [0-9.e+-]+ and \|h J\^-1 pi\| is 1.6, "
    "which must stay below 1"
)


def steps(rotation):
    """Step sizes that turn the body by 0.2, but once by `rotation`."""
    return jnp.where(jnp.arange(STEPS) == BAD, rotation, 0.2) / RATE


def final_attitude(rotation, body=BODY):
    integrator = lgvi.MoserVeselovIntegrator(steps(rotation))
    return integrator.simulate(body, R0, jnp.asarray(PI0)).R[-1]


def entry(rotation, body=BODY):
    """Linear in R: its derivative does not use the values of the trajectory."""
    return final_attitude(rotation, body)[0, 1]


CONTEXTS = {
    "eager": final_attitude,
    "jax.jit": jax.jit(final_attitude),
    "eqx.filter_jit": eqx.filter_jit(final_attitude),
    "vmap": lambda rotation: jax.vmap(final_attitude)(jnp.stack([0.2 + 0 * rotation, rotation])),
    "jit of vmap": jax.jit(jax.vmap(final_attitude)),
    "grad": jax.grad(entry),
    "grad by the body": lambda rotation: jax.grad(entry, argnums=1)(rotation, BODY).inertia,
    "jit of grad": jax.jit(jax.grad(entry)),
    "jit of jacfwd": jax.jit(jax.jacfwd(entry)),
}


# Each further variant of a context that is tested anyway.
VARIANTS = "eqx.filter_jit", "vmap", "grad"


@pytest.mark.parametrize(
    "context",
    [pytest.param(c, marks=pytest.mark.slow if c in VARIANTS else ()) for c in CONTEXTS],
)
def test_the_first_failure_raises_with_its_values(context):
    run = CONTEXTS[context]
    good, bad = jnp.asarray(0.2), jnp.asarray(1.6)
    if context == "jit of vmap":
        good, bad = jnp.array([0.2, 0.3]), jnp.array([0.2, 1.6])
    assert np.all(np.isfinite(run(good)))
    with pytest.raises(RAISED, match=MESSAGE):
        run(bad)


def test_the_message_holds_the_reported_residual():
    quiet = lgvi.MoserVeselovIntegrator(steps(1.6), throw=False)
    info = quiet.simulate(BODY, R0, PI0).solver_info
    np.testing.assert_array_equal(info.converged, np.arange(STEPS) != BAD)
    loud = lgvi.MoserVeselovIntegrator(steps(1.6))
    with pytest.raises(RAISED, match=f"residual is {info.residual_norm[BAD]:.3g} and"):
        loud.simulate(BODY, R0, PI0)


def test_the_first_of_several_failures_is_named():
    dts = jnp.where(jnp.arange(STEPS) < 2, 0.1, 0.8)
    with pytest.raises(RAISED, match=r"Step 2 did not .* pi\| is 1.6,"):
        lgvi.MoserVeselovIntegrator(dts).simulate(BODY, R0, PI0)


def test_the_message_counts_the_half_impulse():
    # An impulse h/2 tau turns the body by h^2/2 = 0.005 for each unit of the torque here. A
    # trajectory has two of them before the failing step: one ends the step before.
    integrator = lgvi.MoserVeselovIntegrator(0.1)
    unit = GENERIC @ AXIS
    torques = np.zeros((STEPS + 1, 3))
    torques[BAD] = 160 * unit
    with pytest.raises(RAISED, match=rf"Step {BAD} did not .* pi\| is 1.8,"):
        integrator.simulate(BODY, R0, PI0, body_torques=torques)
    with pytest.raises(RAISED, match=r"Step 0 did not .* pi\| is 1.8,"):
        eqx.filter_jit(integrator.step)(BODY, R0, PI0, 320 * unit, 0 * unit)


def test_a_step_inside_a_scan_raises():
    @jax.jit
    def run(dt):
        integrator = lgvi.MoserVeselovIntegrator(dt)

        def body(state, _):
            return integrator.step(BODY, *state)[:2], None

        return jax.lax.scan(body, (jnp.asarray(R0), jnp.asarray(PI0)), length=STEPS)[0][0]

    assert np.all(np.isfinite(run(0.1)))
    with pytest.raises(RAISED, match=r"did not converge: .* pi\| is 1.6,"):
        run(0.8)
    with pytest.raises(RAISED, match=r"did not converge: .* pi\| is 1.6,"):
        jax.jit(jax.grad(lambda dt: run(dt)[0, 1]))(0.8)


def test_without_throw_the_failure_is_reported():
    integrator = lgvi.MoserVeselovIntegrator(0.8, throw=False)
    R, pi, info = integrator.step(BODY, R0, PI0)
    assert not info.converged
    assert info.residual_norm > 0.1
    assert np.all(np.isfinite(R))
    assert np.all(np.isfinite(pi))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_raise(value):
    with pytest.raises(RAISED, match="Step 0 did not converge"):
        lgvi.MoserVeselovIntegrator(steps(0.2)).simulate(BODY, R0, PI0 * value)
