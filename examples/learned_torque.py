"""Learn an unknown torque as a neural network, together with the inertia of the body.

    python examples/learned_torque.py
    python examples/learned_torque.py --plot torque.png

A body tumbles in a vertical field that pulls at it: its torque depends on the direction of the
vertical in the body, R^T e_z, by an unknown law. A network takes the place of the law; its weights,
the inertia and all initial states are trained together, by the likelihood of the attitudes.

Torque and inertia of twice the size give the same motion: both are found over the trace of the
inertia. The shape of the inertia and the torque are told apart by speed: gyroscopic effects grow
with its square, and a torque of the attitude alone does not. The optimiser is that of
`fit_inertia.py`, beside this file.
"""

import argparse
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from fit_inertia import fit
from jaxtyping import Array, Float

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    initial_states,
    negative_log_likelihood,
    simulate_recordings,
)

jax.config.update("jax_enable_x64", True)

TRUE = lgvi.PhysicalRigidBody.from_principal_moments([0.25, 0.35, 0.40])  # kg m², of unit trace
NOISE = 1e-3  # rad
CAMERA = lgvi.AttitudeSensor(sigma=1.0)  # so that the likelihood is that of residuals in rad
T = np.linspace(0, 1.2, 13)  # s
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=0.05)
LEARNED, UNSEEN = 32, 16  # trajectories


def true_torque(t: Array, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The torque on a magnet in a vertical field, which also magnetises the body."""
    up = R[2]
    magnet = jnp.array([0.2, -0.1, 0.15]) + jnp.array([0.3, 0.0, -0.2]) * up
    return jnp.cross(magnet, up)


class LearnedTorque(lgvi.AbstractTorque):
    """A torque that is any smooth function of the direction of the vertical in the body."""

    network: eqx.nn.MLP

    def __call__(self, t: Array, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
        return self.network(R[2])


def random_states(count: int, seed: int) -> InitialStates:
    """Attitudes of all directions, and rates up to 3 rad/s."""
    random = np.random.default_rng(seed)
    omega = random.normal(size=(count, 3))
    omega *= random.uniform(0.3, 3, (count, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    R, _ = np.linalg.qr(random.normal(size=(count, 3, 3)))
    return InitialStates(jnp.asarray(R * np.linalg.det(R)[:, None, None]), jnp.asarray(omega))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--iterations", type=int, default=2000, help="of the optimiser, at most (2000)"
    )
    parser.add_argument("--plot", metavar="FILE", help="draw the torques")
    given = parser.parse_args()
    if given.iterations < 1:
        parser.error("--iterations must be at least 1")

    states = random_states(LEARNED + UNSEEN, seed=0)
    truth = Model(TRUE, lgvi.AttitudeSensor(NOISE), torque=true_torque)
    fine = lgvi.MoserVeselovIntegrator(dt=0.005)
    recorded = simulate_recordings(truth, T, states, fine, key=jax.random.key(0))
    learned = recorded.select(recorded.names[:LEARNED])
    unseen = recorded.select(recorded.names[LEARNED:])

    network = eqx.nn.MLP(3, 3, width_size=16, depth=2, activation=jnp.tanh, key=jax.random.key(1))
    sphere = lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3) / 3)
    first = initial_states(Model(sphere, CAMERA), learned)
    likelihood = negative_log_likelihood(learned, INTEGRATOR)
    start = sphere, LearnedTorque(network), jnp.zeros((LEARNED, 6))
    arrays, others = eqx.partition(start, eqx.is_inexact_array)

    def loss(strength, arrays):
        """The mean square of the residuals, mrad², with this part of the torque: none or all."""
        body, torque, moved = eqx.combine(arrays, others)
        model = Model(body, CAMERA, torque=torque * strength)
        return 2e6 * likelihood(model, first.moved(moved)) / (3 * len(T) * LEARNED)

    for name, strength in (("without a torque", 0.0), ("with a learned torque", 1.0)):
        print(f"\n{name}")
        # A pytree with the strength as a leaf: both fits are one program.
        of_this = jax.tree_util.Partial(loss, jnp.asarray(strength))
        found, least = fit(of_this, arrays, given.iterations, tolerance=1e-3)
        # The noise of 1 mrad, less what the fit takes of it, and what the model leaves out.
        print(f"residual of the recorded attitudes: {np.sqrt(least):.2f} mrad for each axis")
        body, torque, _ = eqx.combine(found, others)
        model = Model(body, CAMERA, torque=torque * strength)
        torques = assess(model, unseen, jax.tree.map(lambda x: x[LEARNED:], states))
    if given.plot:
        draw(given.plot, *torques)


def assess(model: Model, unseen: Recordings, states: InitialStates) -> tuple[Array, Array]:
    """Print errors on motions that the fit has not used; the true and the learned torques there."""
    trace = jnp.trace(model.body.inertia)
    wrong = jnp.max(abs(model.body.inertia / trace - TRUE.inertia))
    print(f"largest error of an entry of the inertia over its trace: {wrong:.5f}")
    seen = unseen.channels["attitude"].value  # (trajectories, samples, 3, 3)
    predicted = simulate_recordings(model, unseen, states, INTEGRATOR).channels["attitude"].value
    turn = np.swapaxes(predicted[:, -1], -1, -2) @ seen[:, -1]
    angles = jnp.linalg.norm(jax.vmap(lgvi.so3.log)(turn), axis=-1)
    print(f"unseen motions: {jnp.median(angles):.4f} rad off after {T[-1]} s (median)")
    along = jnp.asarray(seen.reshape(-1, 3, 3))
    laws: Any = true_torque, model.torque
    true, found = (jax.vmap(law, (None, 0))(jnp.zeros(()), along) for law in laws)
    error = jnp.linalg.norm(found / trace - true) / jnp.linalg.norm(true)
    print(f"torque over the trace along unseen motions: {100 * error:.1f} % off (rms)")
    return true, found / trace


def draw(file: str, true: Array, found: Array) -> None:
    """The torques along unseen motions: true ones across, learned ones up."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(8, 3), sharey=True, layout="constrained")
    for component, (axis, name) in enumerate(zip(axes, "xyz", strict=True)):
        axis.plot(true[:, component], found[:, component], ".", ms=3)
        axis.axline((0, 0), slope=1, color="0.5", lw=0.8)
        axis.set(title=f"body {name}", xlabel="true torque / trace (1/s²)")
    axes[0].set_ylabel("learned torque / trace (1/s²)")
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
