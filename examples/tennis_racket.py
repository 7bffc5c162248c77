"""The tennis-racket flip: a body that is spun about its middle axis turns over, again and again.

    python examples/tennis_racket.py [--plot racket.png]

Energy and spatial momentum of a free body do not change. The largest errors after many flips are
printed; the picture shows one flip.
"""

import argparse
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

BODY = lgvi.RigidBody.from_principal_moments([1.0, 2.0, 2.8])  # kg m²
RATES = np.array([0.01, 2.0, 0.01])  # rad/s


@partial(jax.jit, static_argnums=0)
def spin(steps, dt):
    """The motion, and the largest errors of energy, spatial momentum and orthogonality."""
    integrator = lgvi.MoserVeselovIntegrator(dt)
    motion = integrator.simulate(BODY, jnp.eye(3), omega0=RATES, steps=steps)
    energy = jax.vmap(BODY.energy)(motion.pi)
    momentum = jax.vmap(lgvi.spatial_momentum)(motion.R, motion.pi)
    errors = (
        jnp.abs(energy / energy[0] - 1),
        jnp.linalg.norm(momentum - momentum[0], axis=1) / jnp.linalg.norm(momentum[0]),
        jax.vmap(lgvi.ortho_error)(motion.R),
    )
    return motion, [jnp.max(error) for error in errors]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--steps", type=int, default=100_000, help="number of time steps")
    parser.add_argument("--dt", type=float, default=0.01, help="time step, s")
    parser.add_argument("--plot", metavar="FILE", help="draw a flip")
    arguments = parser.parse_args()
    print("compiling ...", flush=True)
    motion, (energy, momentum, orthogonality) = spin(arguments.steps, arguments.dt)
    turned = np.flatnonzero(np.diff(np.sign(motion.pi[:, 1])))
    print(f"{arguments.steps} steps of {arguments.dt:g} s: it turned over {len(turned)} times")
    print(f"largest relative error of the energy:           {energy:.1e}")
    print(f"largest relative error of the spatial momentum: {momentum:.1e}")
    print(f"largest |R^T R - I|:                            {orthogonality:.1e}")
    if arguments.plot:
        from lgvi.plotting import plot_snapshots

        middle = turned[0] if len(turned) else 0  # of the first flip
        flip = jax.tree.map(lambda states: states[max(0, middle - 200) : middle + 201], motion)
        plot_snapshots(BODY, flip).savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
