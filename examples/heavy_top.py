"""A heavy top: spun fast it sleeps, slower its tip goes round in arcs, too slow it falls.

    python examples/heavy_top.py
    python examples/heavy_top.py --plot top.png

The spin that keeps a top upright is at least 2 sqrt(m g l I1) / I3 (H. Goldstein, Classical
Mechanics, section 5.7).
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

ACROSS, ALONG = 0.032, 0.002  # moments about the tip, kg m²
TOP = lgvi.RigidBody.from_principal_moments(jnp.array([ACROSS, ACROSS, ALONG]))
WEIGHT = lgvi.UniformGravity(mass=0.5, offset=jnp.array([0.0, 0.0, 0.25]))
NEEDED = 2 * np.sqrt(0.5 * 9.80665 * 0.25 * ACROSS) / ALONG  # rad/s
# Spin over the one that is needed, and how far the top leans at the start, rad.
CASES = {"sleeping": (1.5, 0.01), "nutating": (1.3, 0.5), "falling": (0.8, 0.01)}
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=1e-3, order=4)


@eqx.filter_jit
def spin(speed: jax.Array, lean: jax.Array) -> lgvi.Trajectory:
    """Four seconds of the top."""
    R0 = lgvi.so3.exp(lean * jnp.array([1.0, 0.0, 0.0]))
    pi0 = TOP.angular_momentum(speed * jnp.array([0.0, 0.0, 1.0]))
    return INTEGRATOR.simulate(TOP, R0, pi0, steps=4000, torque=WEIGHT)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the path of the axis")
    arguments = parser.parse_args()
    print(f"a spin of {NEEDED:.0f} rad/s is needed to keep it upright")
    paths = {}
    for name, (factor, lean) in CASES.items():
        R, pi, _ = spin(jnp.asarray(factor * NEEDED), jnp.asarray(lean))
        paths[name] = np.asarray(R[:, :, 2])  # the axis of the top in space
        total = jax.vmap(TOP.energy)(pi) + jax.vmap(WEIGHT.potential_energy, (None, 0))(0.0, R)
        error = jnp.max(jnp.abs(total / total[0] - 1))
        leans = np.degrees(np.arccos(paths[name][:, 2]))
        print(f"{name:9} at {factor} times that: it leans by {leans.min():.1f} to "
              f"{leans.max():.1f} degrees; the energy changes by {error:.0e}")  # fmt: skip
    if arguments.plot:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, 3, figsize=(8, 3), layout="constrained")
        for axis, (name, path) in zip(axes, paths.items(), strict=True):
            axis.plot(path[:, 0], path[:, 1], lw=0.8)
            axis.set(title=name, xlabel="x of the axis", aspect="equal")
        axes[0].set_ylabel("y of the axis")
        figure.savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
