"""Learn an unknown torque as a neural network, together with the inertia of the body.

    python examples/learned_torque.py
    python examples/learned_torque.py --iterations 2000

A body tumbles in a vertical field that pulls at it: its torque depends on the attitude R through
the direction of the vertical in the body, R^T e_z, by an unknown law. A small network
`eqx.nn.MLP` takes the place of the law. Its weights, the inertia, and the initial states of all
recorded trajectories are trained together, by L-BFGS through the likelihood of the attitudes.

What is observable: torque and inertia of twice the size give the same motion, so attitudes
determine both only divided by the trace of the inertia. Speed separates the shape of the inertia
from the torque: gyroscopic effects grow with the square of the angular velocity, and a torque that
depends on the attitude alone is the same at every speed. So the recordings must pass similar
attitudes at different rates. The network is right near the recorded attitudes only.

The network is compared with a fit without torque, on motions that neither fit has used.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
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

TRUE = lgvi.PhysicalRigidBody.from_principal_moments(
    jnp.array([0.25, 0.35, 0.4])
)  # kg m², of unit trace
SIGMA = 1e-3  # rad
SENSOR = lgvi.AttitudeSensor(SIGMA)
T = np.linspace(0, 1.2, 13)  # s
FINE = lgvi.MoserVeselovIntegrator(dt=0.005)  # for the recordings
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=0.05)  # for the fits
LEARNED, UNSEEN = 32, 16  # trajectories


def true_torque(t: Array, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The torque on a magnet in a vertical field, which also magnetises the body."""
    up = R[2]
    magnet = jnp.array([0.2, -0.1, 0.15]) + jnp.array([0.3, 0.0, -0.2]) * up
    return jnp.cross(magnet, up)


class LearnedTorque(eqx.Module):
    """A torque that is any smooth function of the direction of the vertical in the body."""

    network: eqx.nn.MLP

    def __call__(self, t: Array, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
        return self.network(R[2])


class Unknowns(eqx.Module):
    """Everything that is learned: every array of this module."""

    body: lgvi.PhysicalRigidBody
    torque: LearnedTorque
    phi: Float[Array, "trajectories 6"]  # changes of the initial states from the first guess

    def model(self, strength: float | Array) -> Model:
        """The model with `strength` times the torque; at 0 it does not depend on the network."""
        law = lgvi.ScaledTorque(strength, self.torque)
        return Model(self.body, SENSOR, torque=law)


def random_states(count: int, seed: int) -> InitialStates:
    """Attitudes of all directions, and rates up to 3 rad/s."""
    random = np.random.default_rng(seed)
    omega = random.normal(size=(count, 3))
    omega *= random.uniform(0.3, 3, (count, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    R, _ = np.linalg.qr(random.normal(size=(count, 3, 3)))
    R *= np.linalg.det(R)[:, None, None]
    return InitialStates(jnp.asarray(R), jnp.asarray(omega))


def learner(recordings: Recordings, torque: LearnedTorque, iterations: int):
    """A function of the strength of the torque that fits a model and returns it.

    Both fits use the same function, because its compilation takes longer than a fit.
    """
    body = lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3) / 3)
    first = initial_states(Model(body, SENSOR), recordings)
    start = Unknowns(body, torque, jnp.zeros((len(recordings), 6)))
    likelihood = negative_log_likelihood(recordings, INTEGRATOR)
    optimiser: Any = optax.lbfgs(memory_size=30)  # optax's types leave modules out
    learned, others = eqx.partition(start, eqx.is_inexact_array)

    def loss(arrays, strength):
        unknowns = eqx.combine(arrays, others)
        return likelihood(unknowns.model(strength), first.moved(unknowns.phi))

    value_and_grad = optax.value_and_grad_from_state(loss)

    @jax.jit
    def improve(arrays, state, strength):
        value, gradient = value_and_grad(arrays, strength, state=state)
        step, state = optimiser.update(
            gradient, state, arrays, value=value, grad=gradient, value_fn=loss, strength=strength
        )
        return eqx.apply_updates(arrays, step), state, jnp.asarray(value)

    def learn(strength: float) -> Model:
        # Optax starts some counters weakly typed; made strict, `improve` compiles once, not twice.
        state = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), optimiser.init(learned))
        arrays, values = learned, []
        while len(values) < iterations:
            arrays, state, value = improve(arrays, state, strength)
            values.append(float(value))
            if len(values) > 20 and values[-20] - values[-1] < 0.1:  # the likelihood hardly grows
                break
        # The loss is half the sum of squared whitened residuals, plus the logarithm of the noise.
        squares = 2 * (values[-1] / (3 * len(T) * len(recordings)) - np.log(SIGMA))
        print(f"{len(values)} iterations; residual of the recorded attitudes: "
              f"{1e3 * SIGMA * np.sqrt(squares):.2f} mrad for each axis")  # fmt: skip
        return eqx.combine(arrays, others).model(strength)

    return learn


class Prediction(NamedTuple):
    """What a model predicts for motions that the fit has not used."""

    inertia: Float[Array, "3 3"]  # over its trace
    angles: Float[Array, " trajectories"]  # from the last recorded attitudes, rad
    torque_error: Float[Array, ""]  # of torque over trace: relative, root mean square


@eqx.filter_jit
def predictions(model: Model, states: InitialStates, R: Array | np.ndarray) -> Prediction:
    """Predictions for motions with attitudes `R` (trajectories, samples, 3, 3)."""

    def last(R, omega):
        pi = model.body.angular_momentum(omega)
        steps = round(T[-1] / 0.05)
        return INTEGRATOR.simulate(model.body, R, pi, steps=steps, torque=model.torque).R[-1]

    between = jnp.swapaxes(jax.vmap(last)(states.R, states.omega), -1, -2) @ R[:, -1]
    angles = jnp.linalg.norm(jax.vmap(lgvi.so3.log)(between), axis=-1)
    trace = jnp.trace(model.body.inertia)
    assert model.torque is not None
    true, found = (
        jax.vmap(law, (None, 0))(jnp.zeros(()), jnp.asarray(R).reshape(-1, 3, 3))
        for law in (true_torque, model.torque)
    )
    error = jnp.linalg.norm(found / trace - true) / jnp.linalg.norm(true)
    return Prediction(model.body.inertia / trace, angles, error)


def assess(model: Model, states: InitialStates, unseen: Recordings) -> None:
    """Print how far a model is from the truth, for motions that the fit has not used."""
    R = unseen.channels["attitude"].value
    found = jax.tree.map(np.asarray, predictions(model, states, R))
    wrong = np.max(abs(found.inertia - np.asarray(TRUE.inertia)))
    print(f"moments over their sum: {np.linalg.eigvalsh(found.inertia)}, "
          f"largest error of an entry: {wrong:.5f}")  # fmt: skip
    print(f"unseen motions: {np.median(found.angles):.4f} rad off after {T[-1]} s (median), "
          f"{np.max(found.angles):.4f} rad (worst)")  # fmt: skip
    print(f"torque over the trace along unseen motions: {100 * found.torque_error:.1f} % off (rms)")


def draw(file: Path, model: Model, R: np.ndarray) -> None:
    """The torques along unseen motions: true ones across, learned ones up."""
    import matplotlib.pyplot as plt

    assert model.torque is not None
    along = jax.vmap(true_torque, (None, 0)), jax.vmap(model.torque, (None, 0))
    true, found = (
        np.asarray(law(jnp.zeros(()), jnp.asarray(R).reshape(-1, 3, 3))) for law in along
    )
    found = found / np.trace(model.body.inertia)
    figure, axis = plt.subplots(figsize=(4.5, 4.5), layout="constrained")
    for component, name in enumerate("xyz"):
        axis.plot(true[:, component], found[:, component], ".", ms=3, label=f"body {name}")
    axis.axline((0, 0), slope=1, color="0.5", lw=0.8)
    axis.set(xlabel="true torque over trace (1/s²)", ylabel="learned torque over trace (1/s²)")
    axis.legend(frameon=False)
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--iterations", type=int, default=600, help="at most, of the optimiser")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the torques")
    arguments = parser.parse_args()
    if arguments.iterations < 1:
        parser.error("--iterations must be at least 1")

    states = random_states(LEARNED + UNSEEN, seed=0)
    recorded = simulate_recordings(
        Model(TRUE, SENSOR, torque=true_torque), T, states, FINE, key=jax.random.key(0)
    )
    names = recorded.names
    learned, unseen = recorded.drop(names[LEARNED:]), recorded.drop(names[:LEARNED])
    unseen_states = jax.tree.map(lambda x: x[LEARNED:], states)
    network = eqx.nn.MLP(3, 3, width_size=16, depth=2, activation=jnp.tanh, key=jax.random.key(1))
    print(f"true moments over their sum: {np.linalg.eigvalsh(TRUE.inertia)}")
    learn = learner(learned, LearnedTorque(network), arguments.iterations)
    for heading, strength in (("without a torque", 0.0), ("with a learned torque", 1.0)):
        print(f"\n{heading}")
        model = learn(strength)
        assess(model, unseen_states, unseen)
    if arguments.plot:
        draw(arguments.plot, model, unseen.channels["attitude"].value)


if __name__ == "__main__":
    main()
