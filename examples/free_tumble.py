"""The tennis-racket flip: how well does a long free tumble conserve energy and momentum?

    python examples/free_tumble.py
    python examples/free_tumble.py --plot polhode.png

A body spun about its middle principal axis turns over again and again. The tip of the
body angular momentum then draws a curve, the polhode, where the sphere of constant
momentum meets the ellipsoid of constant energy.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)


def plot(file: Path, body: lgvi.AbstractRigidBody, pi: np.ndarray) -> None:
    import matplotlib.pyplot as plt

    radius = np.linalg.norm(pi[0])
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 121j, -np.pi / 2 : np.pi / 2 : 61j]
    sphere = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    energies = np.einsum("i...,ij,j...->...", sphere, np.linalg.inv(body.inertia), sphere)
    shade = (energies - energies.min()) / np.ptp(energies)

    elevation, azimuth = np.deg2rad([25, 40])
    towards_viewer = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    hidden = (pi @ towards_viewer < 0)[:, None]

    figure = plt.figure(figsize=(5, 5), layout="constrained")
    axis = figure.add_subplot(projection="3d", computed_zorder=False)
    axis.plot_surface(*sphere, facecolors=plt.get_cmap("Blues")(0.15 + 0.6 * shade), shade=False)
    curve = 1.01 * pi / radius
    axis.plot(*np.where(hidden, curve, np.nan).T, color="crimson", lw=1.5, alpha=0.25)
    axis.plot(*np.where(hidden, np.nan, curve).T, color="crimson", lw=2, label="polhode")
    for direction, name in zip(np.eye(3), ("smallest", "middle", "largest"), strict=True):
        axis.plot(*np.outer(direction, [1, 1.25]), color="black")
        x, y, z = 1.3 * direction - [0, 0, 0.25 * (name != "largest")]
        axis.text(x, y, z, f"{name} moment", ha="center")
    axis.set_title("Body angular momentum on its sphere,\nshaded by energy")
    axis.set(xlim=(-0.8, 0.8), ylim=(-0.8, 0.8), zlim=(-0.8, 0.8))
    axis.set_box_aspect((1, 1, 1))
    axis.set_axis_off()
    axis.view_init(elev=25, azim=40)
    axis.legend(loc="lower left")
    figure.savefig(file, dpi=150)
    print(f"picture: {file}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--steps", type=int, default=100_000, help="number of time steps")
    parser.add_argument("--dt", type=float, default=0.01, help="time step in s")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the polhode")
    arguments = parser.parse_args()

    body = lgvi.RigidBody.from_principal_moments(jnp.array([1.0, 2.0, 2.8]))
    integrator = lgvi.MoserVeselovIntegrator(arguments.dt)
    pi0 = body.angular_momentum(jnp.array([0.01, 2.0, 0.01]))
    simulate = eqx.filter_jit(integrator.simulate)
    R, pi, _ = simulate(body, jnp.eye(3), pi0, steps=arguments.steps)

    energy = jax.vmap(body.energy)(pi)
    momentum = jax.vmap(lgvi.spatial_momentum)(R, pi)
    flips = jnp.sum(jnp.diff(jnp.sign(pi[:, 1])) != 0)
    energy_error = jnp.max(jnp.abs(energy / energy[0] - 1))
    momentum_error = jnp.max(jnp.linalg.norm(momentum - pi0, axis=1)) / jnp.linalg.norm(pi0)
    print(f"{arguments.steps} steps of {arguments.dt:g} s: the body turned over {flips} times")
    print(f"largest relative error of the energy:           {energy_error:.1e}")
    print(f"largest relative error of the spatial momentum: {momentum_error:.1e}")
    print(f"largest |R^T R - I|:                            "
          f"{jnp.max(jax.vmap(lgvi.ortho_error)(R)):.1e}")  # fmt: skip
    if arguments.plot:
        plot(arguments.plot, body, np.asarray(pi))


if __name__ == "__main__":
    main()
