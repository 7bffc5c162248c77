"""Fit the inertia of a body to its attitudes by gradient through the simulator, with optax.

    python examples/fit_inertia.py                      tosses that are made up
    python examples/fit_inertia.py --data FILE.csv      yours, with the columns t,qw,qx,qy,qz

Without torque attitudes tell the inertia up to a factor: moments are given as parts of the trace.
Columns are seconds and a unit quaternion, scalar first, body to space; `trajectory` tells tosses
apart. `lgvi.identification.identify` does all this, and more, in one call.
"""

import argparse
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

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
START = lgvi.PhysicalRigidBody.from_principal_moments([0.45, 0.25, 0.30])
CAMERA = lgvi.AttitudeSensor(sigma=1.0)  # so that the likelihood is that of residuals in rad
LARGEST_TURN = 0.1  # rad in a step of order 6
OPTIMISER: Any = optax.lbfgs(memory_size=30)  # optax's types leave modules out


def make_tosses(count: int) -> Recordings:
    """Two seconds of each toss, with noise."""
    omega = 2 * np.random.default_rng(0).normal(size=(count, 3))
    states = InitialStates(jnp.tile(jnp.eye(3), (count, 1, 1)), jnp.asarray(omega))
    model = Model(TRUTH, lgvi.AttitudeSensor(NOISE))
    return simulate_recordings(model, np.linspace(0, 2, 100), states, key=jax.random.key(0))


@eqx.filter_jit
def improve(loss, unknowns, memory):
    # Value and gradient are those of the last line search: the program contains the loss once.
    known = {name: optax.tree.get(memory, name) for name in ("value", "grad")}
    step, memory = OPTIMISER.update(known["grad"], memory, unknowns, **known, value_fn=loss)
    return eqx.apply_updates(unknowns, step), memory, optax.tree.get(memory, "value")


def fit(loss, unknowns, iterations: int, tolerance: float = 1e-7):
    """By L-BFGS, until twenty iterations lower the loss by less than `tolerance` times itself."""
    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(loss))(unknowns)
    memory = optax.tree.set(OPTIMISER.init(unknowns), value=value, grad=gradient)
    # Optax starts some counters weakly typed; made strict, `improve` is compiled once, not twice.
    memory, values = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), memory), []
    while len(values) < iterations:
        unknowns, memory, value = improve(loss, unknowns, memory)
        values.append(float(value))
        if len(values) > 20 and values[-21] - values[-1] < tolerance * values[-1]:
            print(f"settled after {len(values)} iterations")
            return unknowns, values[-1]
    print(f"NOT settled after {iterations} iterations; take more --iterations")
    return unknowns, values[-1]


def parts_of_trace(J) -> str:
    return " ".join(f"{moment:.5f}" for moment in np.linalg.eigvalsh(J) / np.trace(J))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", metavar="FILE.csv", help="recorded attitudes")
    parser.add_argument("--plot", metavar="FILE", help="write a picture")
    parser.add_argument(
        "--iterations", type=int, default=500, help="of the optimiser, at most (500)"
    )
    parser.add_argument("--tosses", type=int, default=8, help="that are made up (8)")
    given = parser.parse_args()
    if given.iterations < 1 or given.tosses < 1:
        parser.error("--iterations and --tosses must be above 0")
    try:
        if given.data:
            tosses = Recordings.from_csv(given.data, attitude=("qw", "qx", "qy", "qz"))
        else:
            tosses = make_tosses(given.tosses)
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")
    print(tosses)

    guess = initial_states(Model(START, CAMERA), tosses)
    fastest = float(np.max(np.linalg.norm(guess.omega, axis=1)))
    integrator = lgvi.MoserVeselovIntegrator(LARGEST_TURN / fastest, order=6)
    likelihood = negative_log_likelihood(tosses, integrator)
    # How far an initial state is from the guess: a turn, and a rate times the duration, all in rad.
    duration = float(np.mean([np.ptp(t) for t in tosses.reading_times()]))
    unit = jnp.array([1.0, 1.0, 1.0, 1 / duration, 1 / duration, 1 / duration])
    count = 3 * len(tosses.channels["attitude"].times)

    def loss(unknowns):
        """The mean square of the residuals, mrad²."""
        body, moved = unknowns
        return 2e6 * likelihood(Model(body, CAMERA), guess.moved(moved * unit)) / count

    start = START, jnp.zeros((len(tosses), 6))
    (body, moved), least = fit(loss, start, given.iterations)
    left = 1 - (6 * len(tosses) + 5) / count  # the part of the noise that the fit leaves
    print(f"residual for each axis: {np.sqrt(least / left):.3f} mrad")
    print("moments, as parts of the trace:", parts_of_trace(body.inertia))
    if not given.data:
        print("true ones:                     ", parts_of_trace(TRUTH.inertia))
    if given.plot:
        draw(given.plot, tosses, {"start": START, "fit": body}, guess.moved(moved * unit))


def draw(file: str, tosses: Recordings, bodies: dict, states: InitialStates) -> None:
    import matplotlib.pyplot as plt

    recorded = tosses.channels["attitude"]
    figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    for axis, (name, body) in zip(axes, bodies.items(), strict=True):
        seen = simulate_recordings(Model(body, CAMERA), tosses, states)
        turn = np.swapaxes(seen.channels["attitude"].values, 1, 2) @ recorded.values
        axis.plot(recorded.times, 1e3 * np.asarray(jax.vmap(lgvi.so3.log)(turn)), ".", ms=2)
        axis.set(title=f"inertia of the {name}", xlabel="time (s)", ylabel="residual (mrad)")
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
