"""An asteroid that tumbles for a million turns, in seconds of computing.

    python examples/asteroid.py [--plot asteroid.png]

The moments are about those of 4179 Toutatis, 3.2 to 3.1 to 1 (S. J. Ostro and others, "Radar images
of asteroid 4179 Toutatis", Science 270 (1995), doi:10.1126/science.270.5233.80). Only every
hundred-thousandth state is stored. No error grows but that of rounding, which walks at random.
"""

import argparse
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

ASTEROID = lgvi.RigidBody.from_principal_moments([1.0, 3.1, 3.2])
RATES = np.array([0.9, 0.3, 0.25])  # 2 pi of the unit of time is about a turn
STEPS = 20  # of a turn
INTEGRATOR = lgvi.MoserVeselovIntegrator(2 * np.pi / np.linalg.norm(RATES) / STEPS, order=8)


@partial(jax.jit, static_argnums=0)
def tumble(steps):
    """The stored states, and the largest relative errors of energy and spatial momentum."""
    R0, every = jnp.eye(3), steps // 200
    motion = INTEGRATOR.simulate(ASTEROID, R0, omega0=RATES, steps=steps, save_every=every)
    energy = jax.vmap(ASTEROID.energy)(motion.pi)
    momentum = jax.vmap(lgvi.spatial_momentum)(motion.R, motion.pi)
    error = jnp.linalg.norm(momentum - momentum[0], axis=1) / jnp.linalg.norm(momentum[0])
    return motion, jnp.max(jnp.abs(energy / energy[0] - 1)), jnp.max(error)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--turns", type=int, default=1_000_000, help="number of turns")
    parser.add_argument("--plot", metavar="FILE", help="draw how errors grow")
    arguments = parser.parse_args()
    if arguments.turns < 10 or arguments.turns % 10:
        parser.error("--turns must be a multiple of 10")
    steps = STEPS * arguments.turns
    print(f"compiling, then {steps} steps ...", flush=True)
    compiled = tumble.lower(steps).compile()
    start = time.perf_counter()
    motion, energy_error, momentum_error = jax.block_until_ready(compiled())
    print(f"{arguments.turns} turns, {steps} steps: {time.perf_counter() - start:.1f} s")
    print(f"largest relative error of the energy:           {energy_error:.1e}")
    print(f"largest relative error of the spatial momentum: {momentum_error:.1e}")
    if arguments.plot:
        from lgvi.plotting import plot_invariants

        plot_invariants(ASTEROID, motion).savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
