"""What is left of energy, momentum and orthogonality after a million steps and more."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, inertia, rng, rotation
from .methods import FORCED

FREE_STEPS, FORCED_STEPS, STORED = 10**6, 5 * 10**5, 1000
PENDULUM = lgvi.UniformGravity(1.0, np.array([0.1, 0.2, 1.0]), 1.0)


def bodies():
    """Twelve random inertias, and momenta that turn the body at 1 rad/s."""
    random = rng(80)
    for i in range(12):
        a, b, c = random.uniform(0.1, 1, 3)
        J = inertia(np.array([a + b, b + c, c + a]), rotation(81, i))
        omega = random.normal(size=3)
        yield J, J @ omega / np.linalg.norm(omega)


@pytest.mark.parametrize("order", [2, 8])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rounding_of_free_motion(line, dtype, order):
    """In units of rounding, half of epsilon, beside those of compensated sums of theirs."""
    integrator = lgvi.MoserVeselovIntegrator(dtype(0.1), order=order, throw=False)
    simulate = partial(integrator.simulate, steps=FREE_STEPS, save_every=FREE_STEPS // 100)
    run = jax.jit(lambda J, pi0: simulate(lgvi.RigidBody(J), jnp.eye(3, dtype=dtype), pi0))
    errors = []
    for J, pi0 in bodies():
        R, pi, info = run(J.astype(dtype), pi0.astype(dtype))
        assert np.all(info.converged)
        J, R, pi = (np.asarray(x, np.longdouble) for x in (J.astype(dtype), R, pi))
        inverse = np.linalg.inv(J.astype(float))
        inverse = inverse @ (2 * np.eye(3) - J @ inverse)  # to the digits of long double
        energy = np.einsum("ni,ij,nj->n", pi, inverse, pi)
        momentum = np.einsum("nij,nj->ni", R, pi)
        errors.append(
            [
                np.max(np.abs(R[-1].T @ R[-1] - np.eye(3))),
                energy[-1] / energy[0] - 1,
                np.linalg.norm(momentum[-1] - momentum[0]) / np.linalg.norm(momentum[0]),
            ]
        )
    sizes = np.sqrt(np.mean(np.square(errors), axis=0)) / (np.finfo(dtype).eps / 2)
    name = f"10^6 free steps, {np.dtype(dtype)}, order {order}"
    values = zip(("R", "energy", "momentum"), sizes, strict=True)
    line(f"{name:42} " + ", ".join(f"{what} {size:.1f}" for what, size in values) + " units")
    assert np.all(sizes < 20 * np.array([1.5, 118, 168]))


@pytest.mark.parametrize("name", FORCED)
def test_energy_of_chaotic_pendulums(line, name):
    """Eight that begin almost alike: one alone may spend a tenth of its time in a rare place.

    In the first tenth they still go together, and the error begins at zero; so it is not compared.
    """
    body, pi0 = lgvi.RigidBody(jnp.asarray(GENERIC)), GENERIC @ np.array([0.9, 0.8, -0.6])
    integrator = lgvi.MoserVeselovIntegrator(0.1, throw=False, **FORCED[name])
    simulate = partial(
        integrator.simulate, steps=FORCED_STEPS, save_every=FORCED_STEPS // STORED, torque=PENDULUM
    )

    @jax.jit
    @jax.vmap
    def run(pi0):
        R, pi, info = simulate(body, jnp.eye(3), pi0)
        energy = jax.vmap(body.energy)(pi) + jax.vmap(PENDULUM.potential_energy, (None, 0))(0.0, R)
        return energy - energy[0], info.converged

    error, converged = map(np.asarray, run(pi0 + 1e-9 * np.arange(8)[:, None]))
    assert np.all(converged)
    tenth = STORED // 10
    ends = [np.abs(error[:, part]) for part in (slice(tenth, 2 * tenth), slice(-tenth, None))]
    text = " and ".join(f"{np.max(part):.1e} (mean {np.mean(part):.1e})" for part in ends)
    line(f"{f'pendulums, {name}':42} energy error {text} in the second and last tenth")
    early, last = ends
    assert np.mean(np.max(last, axis=1)) < 1.5 * np.mean(np.max(early, axis=1))
    assert abs(np.mean(last) - np.mean(early)) < np.std(error) / 4


def test_the_pendulum_is_chaotic():
    integrator = lgvi.MoserVeselovIntegrator(0.1, throw=False, order=8)
    body, pi0 = lgvi.RigidBody(jnp.asarray(GENERIC)), GENERIC @ np.array([0.9, 0.8, -0.6])
    simulate = partial(integrator.simulate, body, jnp.eye(3), steps=10_000, torque=PENDULUM)
    near = jnp.linalg.norm(simulate(pi0).R - simulate(pi0 + 1e-10).R, axis=(1, 2))
    assert near[1] < 1e-9
    assert jnp.max(near) > 1
