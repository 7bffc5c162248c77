"""Learn an unknown torque as a neural network, together with the inertia of the body.

    python examples/learned_torque.py [--plot torque.png]

A body tumbles in a vertical field that pulls at it: its torque depends on the direction of the
vertical in the body, R^T e_z, by an unknown law. A network takes the place of the law; its weights,
the inertia and all initial states are trained together, on recorded attitudes.

Torque and inertia of twice the size give the same motion: both are found over the trace of the
inertia. The shape of the inertia and the torque are told apart by speed: gyroscopic effects grow
with its square, and a torque of the attitude alone does not.
"""

import argparse
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Float

import lgvi

jax.config.update("jax_enable_x64", True)

TRUE = lgvi.PhysicalRigidBody.from_principal_moments([0.25, 0.35, 0.40])  # kg m², of unit trace
NOISE = 1e-3  # rad
T = np.linspace(0, 1.2, 13)  # s
LEARNED, UNSEEN = 32, 16  # trajectories
INTEGRATOR = lgvi.MoserVeselovIntegrator()
STEPS = 4000
OPTIMISER: Any = optax.adam(optax.cosine_decay_schedule(0.01, STEPS), b1=0.98, b2=0.98)


def true_torque(t: ArrayLike, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The torque on a magnet in a vertical field, which also magnetises the body."""
    up = R[2]
    magnet = jnp.array([0.2, -0.1, 0.15]) + jnp.array([0.3, 0.0, -0.2]) * up
    return jnp.cross(magnet, up)


class LearnedTorque(lgvi.AbstractTorque):
    """A torque that is any smooth function of the direction of the vertical in the body."""

    network: eqx.nn.MLP

    def __call__(self, t: ArrayLike, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
        return self.network(R[2])


def random_states(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes of all directions, and rates up to 3 rad/s."""
    random = np.random.default_rng(seed)
    omega = random.normal(size=(count, 3))
    omega *= random.uniform(0.3, 3, (count, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    R, _ = np.linalg.qr(random.normal(size=(count, 3, 3)))
    return R * np.linalg.det(R)[:, None, None], omega


def simulate(body, torque, R0, omega0, substeps: int = 2) -> Float[Array, "trajectories times 3 3"]:
    """Attitudes at the times T."""
    fly = partial(INTEGRATOR.simulate, body, times=T, substeps=substeps, torque=torque)
    return jax.vmap(fly)(R0, omega0=omega0).R


@jax.jit
def record(R0, omega0):
    """Attitudes under the true torque, with noise."""
    noise = NOISE * jax.random.normal(jax.random.key(0), (len(R0), len(T), 3))
    exact = simulate(TRUE, true_torque, R0, omega0, substeps=20)
    return exact @ jax.vmap(jax.vmap(lgvi.so3.exp))(noise)


@eqx.filter_jit
def fit(model, strength, recorded):
    """Body, torque and residual for each axis, mrad, after all steps of the optimiser."""
    omega0 = jax.vmap(lgvi.so3.log)(recorded[:, 0].mT @ recorded[:, 1]) / T[1]
    start, others = eqx.partition((model, 0 * omega0, omega0), eqx.is_inexact_array)

    def loss(arrays):
        (body, torque), turn, omega0 = eqx.combine(arrays, others)
        R0 = recorded[:, 0] @ jax.vmap(lgvi.so3.exp)(turn)
        difference = simulate(body, torque * strength, R0, omega0) - recorded
        squares = jnp.sum(difference**2, axis=(2, 3)) / 2  # of the angles, which are small
        return 1e6 * jnp.mean(squares) / 3

    def improve(state, _) -> Any:
        arrays, memory = state
        value, gradient = jax.value_and_grad(loss)(arrays)
        change, memory = OPTIMISER.update(gradient, memory)
        return (optax.apply_updates(arrays, change), memory), value

    state, values = jax.lax.scan(improve, (start, OPTIMISER.init(start)), length=STEPS)
    (body, torque), *_ = eqx.combine(state[0], others)
    return body, torque * strength, jnp.sqrt(values[-1])


@eqx.filter_jit
def assess(body, torque, recorded, R0, omega0):
    """Errors on motions that the fit has not used; the true and the learned torques there."""
    J = body.inertia / jnp.trace(body.inertia)
    simulated = simulate(body, torque, R0, omega0)
    angles = jax.vmap(lgvi.so3.distance)(simulated[:, -1], recorded[:, -1])
    along = recorded.reshape(-1, 3, 3)
    true, learned = (jax.vmap(law, (None, 0))(0.0, along) for law in (true_torque, torque))
    learned /= jnp.trace(body.inertia)
    error = jnp.linalg.norm(learned - true) / jnp.linalg.norm(true)
    return jnp.max(abs(J - TRUE.inertia)), jnp.median(angles), 100 * error, (true, learned)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw the torques")
    file = parser.parse_args().plot
    print(f"compiling, then twice {STEPS} steps of the optimiser ...", flush=True)
    R0, omega0 = random_states(LEARNED + UNSEEN, seed=0)
    recorded = record(R0, omega0)
    network = eqx.nn.MLP(3, 3, width_size=16, depth=2, activation=jnp.tanh, key=jax.random.key(1))
    sphere = lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3) / 3)
    unseen, torques = [values[LEARNED:] for values in (recorded, R0, omega0)], ()
    for name, strength in (("without a torque", 0.0), ("with a learned torque", 1.0)):
        # The strength is an array: both fits are one program.
        start = sphere, LearnedTorque(network)
        body, torque, residual = fit(start, jnp.asarray(strength), recorded[:LEARNED])
        wrong, off, error, torques = assess(body, torque, *unseen)
        print(f"\n{name}\nresidual of the recorded attitudes: {residual:.2f} mrad for each axis")
        print(f"largest error of an entry of the inertia over its trace: {wrong:.5f}")
        print(f"unseen motions: {off:.4f} rad off after {T[-1]} s (median)")
        print(f"torque over the trace along unseen motions: {error:.1f} % off (rms)")
    if file:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, 3, figsize=(8, 3), sharey=True, layout="constrained")
        for axis, name, true, learned in zip(axes, "xyz", *(law.T for law in torques), strict=True):
            axis.plot(true, learned, ".", ms=3)
            axis.axline((0, 0), slope=1, color="0.5", lw=0.8)
            axis.set(title=f"body {name}", xlabel="true torque / trace (1/s²)")
        axes[0].set_ylabel("learned torque / trace (1/s²)")
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
