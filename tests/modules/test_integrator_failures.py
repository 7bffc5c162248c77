"""A step that cannot be solved: raised in every context, with values where known, or reported."""

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
PLAIN = "a step did not converge, .* says which, with the values"


def steps(rotation):
    """Step sizes that turn the body by 0.2, but once by `rotation`."""
    return jnp.where(jnp.arange(STEPS) == BAD, rotation, 0.2) / RATE


def final_attitude(rotation, body=BODY):
    integrator = lgvi.MoserVeselovIntegrator(steps(rotation))
    return integrator.simulate(body, R0, jnp.asarray(PI0)).R[-1]


def entry(rotation, body=BODY):
    """Linear in R: its derivative does not use the values of the trajectory."""
    return final_attitude(rotation, body)[0, 1]


EAGER = {
    "eager": final_attitude,
    "grad": jax.grad(entry),
    "grad by the body": lambda rotation: jax.grad(entry, argnums=1)(rotation, BODY).inertia,
}
CONTEXTS = EAGER | {
    "jax.jit": jax.jit(final_attitude),
    "eqx.filter_jit": eqx.filter_jit(final_attitude),
    "vmap": lambda rotation: jax.vmap(final_attitude)(jnp.stack([0.2 + 0 * rotation, rotation])),
    "jit of vmap": jax.jit(jax.vmap(final_attitude)),
    "jit of grad": jax.jit(jax.grad(entry)),
    "jit of jacfwd": jax.jit(jax.jacfwd(entry)),
}


# Each further variant of a context that is tested anyway.
VARIANTS = "eqx.filter_jit", "vmap", "grad"


@pytest.mark.parametrize(
    "context",
    [pytest.param(c, marks=pytest.mark.slow if c in VARIANTS else ()) for c in CONTEXTS],
)
def test_the_first_failure_raises_and_is_named_outside_of_compiled_functions(context):
    run = CONTEXTS[context]
    good, bad = jnp.asarray(0.2), jnp.asarray(1.6)
    if context == "jit of vmap":
        good, bad = jnp.array([0.2, 0.3]), jnp.array([0.2, 1.6])
    assert np.all(np.isfinite(run(good)))
    with pytest.raises(RAISED, match=MESSAGE if context in EAGER else PLAIN):
        run(bad)


def test_the_message_holds_the_reported_residual():
    quiet = lgvi.MoserVeselovIntegrator(steps(1.6), throw=False)
    info = quiet.simulate(BODY, R0, PI0).solver_info
    np.testing.assert_array_equal(info.converged, np.arange(STEPS) != BAD)
    loud = lgvi.MoserVeselovIntegrator(steps(1.6))
    with pytest.raises(RAISED, match=f"residual is {info.residual_norm[BAD]:.3g} and"):
        loud.simulate(BODY, R0, PI0)


def test_the_first_of_several_failures_is_named_and_what_makes_steps_shorter():
    dts = jnp.where(jnp.arange(STEPS) < 2, 0.1, 0.8)
    with pytest.raises(RAISED, match=r"Step 2 did not .* pi\| is 1.6,.* Take a smaller `dt` "):
        lgvi.MoserVeselovIntegrator(dts).simulate(BODY, R0, PI0)
    times = jnp.append(0, jnp.cumsum(dts))
    with pytest.raises(RAISED, match=r"Step 2 did not .* pi\| is 1.6,.* Take more `substeps` "):
        lgvi.MoserVeselovIntegrator().simulate(BODY, R0, PI0, times=times)


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
        integrator.step(BODY, R0, PI0, 320 * unit, 0 * unit)


NOT_A_ROTATION = "`R0` must be a rotation matrix, but is "
NOT_AN_INERTIA = "inertia of the body must be symmetric and positive definite, but is "
EYE, MOMENTS = np.eye(3), np.diag([1.0, 2.0, 2.5])
IMPOSSIBLE = {
    "twice a rotation": (MOMENTS, 2 * EYE, NOT_A_ROTATION),
    "reflection": (MOMENTS, -EYE, NOT_A_ROTATION + r".* determinant is -1\."),
    "nearly a rotation": (
        MOMENTS,
        (1 + 1e-4) * EYE,
        NOT_A_ROTATION + ".* takes such an error away",
    ),
    "not a number": (MOMENTS, np.nan * EYE, NOT_A_ROTATION),
    "indefinite": (np.diag([1, -1, 2.5]), EYE, NOT_AN_INERTIA + ".* moments -1, 1, 2.5"),
    "indefinite, diagonal positive": (MOMENTS + 3 * (1 - EYE), EYE, NOT_AN_INERTIA),
    "negative": (-MOMENTS, EYE, NOT_AN_INERTIA),
    "singular": (np.diag([1, 2, 0.0]), EYE, NOT_AN_INERTIA),
    "not symmetric": (MOMENTS + np.diag([0.01, 0], 1), EYE, NOT_AN_INERTIA),
    "no inertia": (np.nan * EYE, EYE, NOT_AN_INERTIA),
}
POSSIBLE = {
    "no triangle": (np.diag([1, 1, 2.5]), EYE),
    "rounding": (MOMENTS + np.diag([1e-9, 0], 1), (1 + 2e-7) * EYE),
    "small": (1e-20 * MOMENTS, EYE),
    "thin": (np.diag([1, 1, 1e-5]), EYE),
}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_body_that_cannot_be_is_refused(dtype):
    def run(J, R0, throw):
        body, omega = lgvi.RigidBody(J), jnp.asarray([0.1, 0.2, 0.3], dtype)
        integrator = lgvi.MoserVeselovIntegrator(jnp.asarray(0.1, dtype), throw=throw)
        info = integrator.simulate(body, R0, J @ omega, steps=2).solver_info
        _, _, of_step = integrator.step(body, R0, J @ omega)
        return info.converged, of_step.converged

    impossible = dict(IMPOSSIBLE)
    if dtype == jnp.float32:
        del impossible["nearly a rotation"]  # products of attitudes are no better
    for cases, expected in ((POSSIBLE, True), (impossible, False)):
        matrices = list(zip(*cases.values(), strict=True))[:2]
        given = [jnp.asarray(np.stack(x), dtype) for x in matrices]
        for converged in jax.jit(jax.vmap(lambda J, R: run(J, R, False)))(*given):
            for case, each in zip(cases, converged, strict=True):
                assert np.all(each == expected), case
    raising = jax.jit(lambda J, R: run(J, R, True)[0])
    for J, R, message in impossible.values():
        J, R = jnp.asarray(J, dtype), jnp.asarray(R, dtype)
        with pytest.raises(RAISED, match=PLAIN):
            jax.block_until_ready(raising(J, R))
        with pytest.raises(RAISED, match=message):
            run(J, R, True)


def test_a_body_in_degrees_is_suspected():
    integrator = lgvi.MoserVeselovIntegrator(0.1)
    with pytest.raises(RAISED, match="rates are in rad/s, not in degrees/s"):
        integrator.simulate(BODY, R0, np.degrees(PI0), steps=STEPS)


def test_a_state_that_an_impulse_makes_nan_has_not_converged():
    torques = np.zeros((STEPS + 1, 3))
    torques[STEPS - 1] = np.nan
    integrator = lgvi.MoserVeselovIntegrator(0.1, throw=False)
    _, pi, info = integrator.simulate(BODY, R0, PI0, body_torques=torques)
    np.testing.assert_array_equal(info.converged, np.arange(STEPS) < STEPS - 2)
    np.testing.assert_array_equal(info.converged, np.all(np.isfinite(pi[1:]), axis=1))
    loud = lgvi.MoserVeselovIntegrator(0.1)
    with pytest.raises(RAISED, match=f"Step {STEPS - 2} did not .* at its end is not finite"):
        loud.simulate(BODY, R0, PI0, body_torques=torques)


def test_a_step_inside_a_scan_raises():
    @jax.jit
    def run(dt):
        integrator = lgvi.MoserVeselovIntegrator(dt)

        def body(state, _):
            return integrator.step(BODY, *state)[:2], None

        return jax.lax.scan(body, (jnp.asarray(R0), jnp.asarray(PI0)), length=STEPS)[0][0]

    assert np.all(np.isfinite(run(0.1)))
    with pytest.raises(RAISED, match=PLAIN):
        run(0.8)
    with pytest.raises(RAISED, match=PLAIN):
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
    for dt, pi0, words in (
        (0.2, PI0 * value, "The first momentum, or a torque until then, is not finite"),
        (value, PI0, "`dt` is not finite"),
    ):
        with pytest.raises(RAISED, match=f"did not converge.*{words}"):
            lgvi.MoserVeselovIntegrator(steps(dt)).simulate(BODY, R0, pi0)
