"""An asteroid that tumbles for a million turns, in seconds of computing.

    python examples/asteroid.py
    python examples/asteroid.py --plot asteroid.png

The moments are about those of 4179 Toutatis, 3.2 to 3.1 to 1 (S. J. Ostro and others, "Radar images
of asteroid 4179 Toutatis", Science 270 (1995), doi:10.1126/science.270.5233.80). Only every
hundred-thousandth state is stored. No error grows but that of rounding, which walks at random.
"""

import argparse
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

ASTEROID = lgvi.RigidBody.from_principal_moments(jnp.array([1.0, 3.1, 3.2]))
RATES = jnp.array([0.9, 0.3, 0.25])  # 2 pi of the unit of time is about a turn
STEPS = 20  # of a turn


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--turns", type=int, default=1_000_000, help="number of turns")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw how errors grow")
    arguments = parser.parse_args()
    if arguments.turns < 10 or arguments.turns % 10:
        parser.error("--turns must be a multiple of 10")

    pi0 = ASTEROID.angular_momentum(RATES)
    dt = 2 * np.pi / float(jnp.linalg.norm(RATES)) / STEPS
    integrator = lgvi.MoserVeselovIntegrator(dt, order=8)
    count = STEPS * arguments.turns
    simulate = eqx.filter_jit(integrator.simulate)
    simulate(ASTEROID, jnp.eye(3), pi0, steps=count, save_every=count // 200).R.block_until_ready()
    start = time.perf_counter()
    trajectory = simulate(ASTEROID, jnp.eye(3), pi0, steps=count, save_every=count // 200)
    trajectory.R.block_until_ready()
    seconds = time.perf_counter() - start

    energy = jax.vmap(ASTEROID.energy)(trajectory.pi)
    momentum = jax.vmap(lgvi.spatial_momentum)(trajectory.R, trajectory.pi)
    energy_error = jnp.max(jnp.abs(energy / energy[0] - 1))
    momentum_error = jnp.max(jnp.linalg.norm(momentum - pi0, axis=1)) / jnp.linalg.norm(pi0)
    print(f"{arguments.turns} turns, {count} steps: {seconds:.1f} s")
    print(f"largest relative error of the energy:           {energy_error:.1e}")
    print(f"largest relative error of the spatial momentum: {momentum_error:.1e}")
    if arguments.plot:
        from lgvi.plotting import plot_invariants

        figure = plot_invariants(ASTEROID, trajectory)
        figure.savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
