"""Fit the inertia of a body to its attitudes by gradient through the simulator, with optax.

    python examples/fit_inertia.py                      tosses that are made up
    python examples/fit_inertia.py --data FILE.csv      yours, with the columns t,qw,qx,qy,qz
    python examples/fit_inertia.py --plot fit.png       and a picture

Without torque attitudes tell the inertia up to a factor: moments are given as parts of the trace.
Columns are seconds and a unit quaternion, scalar first, body to space; `trajectory` tells tosses
apart. `lgvi.identification.identify` does all this, and more, in one call.
"""

import argparse
from pathlib import Path
from typing import Any

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

NOISE = 1e-3  # rad, of the attitudes that are made up
AXES = lgvi.so3.exp(np.array([0.4, -0.7, 0.5]))
TRUTH = lgvi.PhysicalRigidBody.from_principal_moments([0.20, 0.36, 0.44], AXES)
CAMERA = lgvi.AttitudeSensor(sigma=1.0)  # so that the likelihood is that of residuals in rad
START = lgvi.PhysicalRigidBody.from_principal_moments([0.45, 0.25, 0.30])
LARGEST_TURN = 0.1  # rad in a step of order 6
OPTIMISER: Any = optax.lbfgs(memory_size=30)  # optax's types leave modules out


def make_tosses(count: int, seed: int) -> Recordings:
    """Two seconds of each toss, with the noise of the camera."""
    random = np.random.default_rng(seed)
    omega = random.normal(size=(count, 3))
    omega *= random.uniform(2, 4, (count, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    states = InitialStates(jnp.tile(jnp.eye(3), (count, 1, 1)), jnp.asarray(omega))
    t, integrator = np.linspace(0, 2, 100), lgvi.MoserVeselovIntegrator(dt=0.01, order=8)
    model = Model(TRUTH, lgvi.AttitudeSensor(NOISE))
    return simulate_recordings(model, t, states, integrator, key=jax.random.key(seed))


class Unknowns(eqx.Module):
    """What is fitted: one inertia, and for each toss how far its initial state is from a guess."""

    body: lgvi.PhysicalRigidBody
    turn: Float[Array, "tosses 3"]  # rad
    rate: Float[Array, "tosses 3"]  # times the duration: an angle too, rad

    def states(self, guess: InitialStates, duration: float) -> InitialStates:
        return guess.moved(jnp.concatenate([self.turn, self.rate / duration], axis=1))


@eqx.filter_jit
def update(loss, unknowns: Unknowns, memory: Any) -> tuple[Unknowns, Any, Array]:
    # Value and gradient are those of the last line search: the program contains the loss once.
    known = {name: optax.tree.get(memory, name) for name in ("value", "grad")}
    step, memory = OPTIMISER.update(known["grad"], memory, unknowns, **known, value_fn=loss)
    return eqx.apply_updates(unknowns, step), memory, optax.tree.get(memory, "value")


def fit(loss, unknowns: Unknowns, iterations: int) -> tuple[Unknowns, float]:
    """The least loss by L-BFGS, until it no longer falls."""
    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(loss))(unknowns)
    memory = optax.tree.set(OPTIMISER.init(unknowns), value=value, grad=gradient)
    # Optax starts some counters weakly typed; made strict, `update` is compiled once, not twice.
    memory, values = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), memory), []
    for _ in range(iterations):
        unknowns, memory, value = update(loss, unknowns, memory)
        values.append(float(value))
        if len(values) > 20 and values[-20] - values[-1] < 1e-7 * values[-1]:
            print(f"settled after {len(values)} iterations")
            return unknowns, values[-1]
    print(f"NOT settled after {iterations} iterations; take more --iterations")
    return unknowns, values[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, metavar="FILE.csv", help="recorded attitudes")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a picture")
    parser.add_argument("--iterations", type=int, default=500, help="of the optimiser, at most")
    parser.add_argument("--tosses", type=int, default=8, help="that are made up")
    arguments = parser.parse_args()
    if arguments.iterations < 1 or arguments.tosses < 1:
        parser.error("--iterations and --tosses must be above 0")
    try:
        columns = ("qw", "qx", "qy", "qz")
        recordings = (
            Recordings.from_csv(arguments.data, attitude=columns)
            if arguments.data
            else make_tosses(arguments.tosses, seed=0)
        )
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")
    print(recordings)

    guess = initial_states(Model(START, CAMERA), recordings)
    fastest = float(np.max(np.linalg.norm(guess.omega, axis=1)))
    integrator = lgvi.MoserVeselovIntegrator(LARGEST_TURN / fastest, order=6)
    likelihood = negative_log_likelihood(recordings, integrator)

    duration = float(np.mean([np.ptp(t) for t in recordings.reading_times()]))
    count = 3 * len(recordings.channels["attitude"].times)

    def loss(unknowns: Unknowns) -> Array:
        """The mean square of the residuals, mrad²."""
        model = Model(unknowns.body, CAMERA)
        return 2e6 * likelihood(model, unknowns.states(guess, duration)) / count

    zeros = jnp.zeros((len(recordings), 3))
    unknowns, least = fit(loss, Unknowns(START, zeros, zeros), arguments.iterations)
    left = 1 - (6 * len(recordings) + 5) / count  # the part of the noise that the fit leaves
    print(f"residual for each axis: {np.sqrt(least / left):.3f} mrad")
    moments = jnp.linalg.eigvalsh(unknowns.body.inertia)
    parts = moments / jnp.sum(moments)
    print("moments, as parts of the trace:", *(f"{part:.5f}" for part in parts))
    if not arguments.data:
        true = np.linalg.eigvalsh(TRUTH.inertia)
        print("true ones:                     ", *(f"{moment:.5f}" for moment in true))
    if arguments.plot:
        bodies = {"inertia of the start": START, "fit": unknowns.body}
        draw(arguments.plot, recordings, bodies, unknowns.states(guess, duration))


def draw(file: Path, recordings: Recordings, bodies: dict, states: InitialStates) -> None:
    import matplotlib.pyplot as plt

    recorded = recordings.channels["attitude"]
    figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    for axis, (title, body) in zip(axes, bodies.items(), strict=True):
        seen = simulate_recordings(Model(body, CAMERA), recordings, states).channels["attitude"]
        error = np.swapaxes(seen.values, 1, 2) @ recorded.values
        axis.plot(recorded.times, 1e3 * np.asarray(jax.vmap(lgvi.so3.log)(error)), ".", ms=2)
        axis.set(title=title, xlabel="time (s)", ylabel="residual (mrad)")
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
