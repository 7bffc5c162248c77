"""The tennis-racket flip: a body that is spun about its middle axis turns over, again and again.

    python examples/tennis_racket.py
    python examples/tennis_racket.py --plot racket.png

Energy and spatial momentum of a free body do not change. The largest errors after many flips are
printed; the picture shows one flip.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

BODY = lgvi.RigidBody.from_principal_moments(jnp.array([1.0, 2.0, 2.8]))  # kg m²
RATES = jnp.array([0.01, 2.0, 0.01])  # rad/s


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--steps", type=int, default=100_000, help="number of time steps")
    parser.add_argument("--dt", type=float, default=0.01, help="time step, s")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw a flip")
    arguments = parser.parse_args()

    integrator = lgvi.MoserVeselovIntegrator(arguments.dt)
    pi0 = BODY.angular_momentum(RATES)
    simulate = eqx.filter_jit(integrator.simulate)
    trajectory = simulate(BODY, jnp.eye(3), pi0, steps=arguments.steps)

    R, pi, _ = trajectory
    energy = jax.vmap(BODY.energy)(pi)
    momentum = jax.vmap(lgvi.spatial_momentum)(R, pi)
    turned = np.flatnonzero(np.diff(np.sign(pi[:, 1])))
    energy_error = jnp.max(jnp.abs(energy / energy[0] - 1))
    momentum_error = jnp.max(jnp.linalg.norm(momentum - pi0, axis=1)) / jnp.linalg.norm(pi0)
    orthogonality = jnp.max(jax.vmap(lgvi.ortho_error)(R))
    print(f"{arguments.steps} steps of {arguments.dt:g} s: it turned over {len(turned)} times")
    print(f"largest relative error of the energy:           {energy_error:.1e}")
    print(f"largest relative error of the spatial momentum: {momentum_error:.1e}")
    print(f"largest |R^T R - I|:                            {orthogonality:.1e}")
    if arguments.plot:
        from lgvi.plotting import plot_snapshots

        middle = turned[0] if len(turned) else 0  # of the first flip
        around = slice(max(0, middle - 200), middle + 201)
        flip = replace(trajectory, R=R[around], pi=pi[around], t=trajectory.t[around])
        plot_snapshots(BODY, flip).savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
