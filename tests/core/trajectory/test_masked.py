"""Gradients of a batch in which some steps did not converge, and a mask leaves these out."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ...systems import GENERIC, PI0, R0

STEPS = 6
GOOD = {
    "inertia": GENERIC,
    "pi0": PI0,
    "R0": R0,
    "dt": np.full(STEPS, 0.1),
    "rotor": np.full(3, 0.1),
    "torque": np.full((STEPS + 1, 3), 0.1),
    "k": np.array(0.5),
}
ALL, SOME, NONE = (np.arange(STEPS) < count for count in (STEPS, 2, 0))


def with_nan(name, used=NONE, where: Any = ...):
    value = GOOD[name].copy()
    value[where] = np.nan
    return GOOD | {name: value}, used


# What is given, and the steps that the loss uses.
CASES = {
    "two steps": (GOOD, SOME),
    "later steps": with_nan("dt", SOME, slice(3, None)),
    "too fast": (GOOD | {"pi0": 60 * PI0}, NONE),
    "no body": (GOOD | {"inertia": 0 * GENERIC}, NONE),
    "used": with_nan("pi0", ALL),
    **{name: with_nan(name) for name in GOOD},
}


def free(given, order):
    return simulate(given, order, lgvi.RigidBody(given["inertia"]))


def torques(given, order):
    return simulate(given, order, lgvi.RigidBody(given["inertia"]), body_torques=given["torque"])


def rotors(given, order):
    return simulate(given, order, lgvi.Gyrostat(given["inertia"], given["rotor"]))


def of_time(given, order):
    def torque(t, R):
        return jnp.array([0.0, given["k"] ** 2 * t, 1.0])

    return simulate(given, order, lgvi.RigidBody(given["inertia"]), torque=torque)


def of_attitude(given, order):
    def torque(t, R):
        return jnp.sin(given["k"]) * jnp.cross(R[2], jnp.array([0.0, 0.0, 1.0]))

    return simulate(given, order, lgvi.RigidBody(given["inertia"]), torque=torque)


def of_rate(given, order):
    def torque(t, R, omega):
        return -given["k"] * jnp.linalg.norm(omega) * omega

    def controller(t, R, pi):
        return -(given["k"] ** 2) * pi

    acting = {"torque": torque, "controller": controller}
    return simulate(given, order, lgvi.RigidBody(given["inertia"]), **acting)


def simulate(given, order, body, **acting):
    integrator = lgvi.MoserVeselovIntegrator(given["dt"], order=order, throw=False)
    R, pi, info = integrator.simulate(body, given["R0"], given["pi0"], **acting)
    return R[1:], pi[1:], info.converged


def steps(given, order):
    integrator = lgvi.MoserVeselovIntegrator(given["dt"][0], order=order, throw=False)
    body, R, pi = lgvi.RigidBody(given["inertia"]), given["R0"], given["pi0"]
    states = []
    for i in range(2):
        torques = given["torque"][2 * i : 2 * i + 2]
        R, pi, info = integrator.step(body, R, pi, *torques)
        states.append((R, pi, info.converged))
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


@pytest.mark.parametrize(
    ("motion", "order"),
    [
        (free, 8),
        (torques, 2),
        (of_attitude, 2),
        (steps, 2),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [(rotors, 2), (of_time, 4), (of_attitude, 4), (of_rate, 2)]
        ),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_what_a_mask_leaves_out_has_no_gradient(motion, order):
    def loss(given, used):
        R, pi, converged = motion(given, order)
        used = used[: len(converged)]
        chosen = jnp.where(used[:, None, None], R, 0), jnp.where(used[:, None], pi, 0)
        weights = jnp.arange(9.0).reshape(1, 3, 3)
        return jnp.sum(weights * chosen[0]) + jnp.sum(chosen[1] ** 2), converged

    given, used = jax.tree.map(lambda *xs: np.stack(xs), *CASES.values())
    derivative = jax.jit(jax.vmap(jax.grad(loss, has_aux=True)))
    gradients, converged = derivative(given, used)
    gradients = {
        case: {name: gradient[i] for name, gradient in gradients.items()}
        for i, case in enumerate(CASES)
    }
    converged = dict(zip(CASES, np.asarray(converged), strict=True))

    assert np.all(converged["two steps"])
    assert motion is of_rate or not np.any(converged["too fast"])  # damping slows the body
    for name in GOOD:
        assert np.all(np.isfinite(gradients["two steps"][name])), name
        np.testing.assert_allclose(
            gradients["later steps"][name], gradients["two steps"][name], rtol=1e-12, atol=1e-14
        )
    for case in ("too fast", "no body", *GOOD):
        for name in GOOD:
            np.testing.assert_array_equal(gradients[case][name], 0, err_msg=f"{case}, {name}")
    for name in ("inertia", "R0", "dt"):
        assert np.all(np.isnan(gradients["used"][name][:1])), name
