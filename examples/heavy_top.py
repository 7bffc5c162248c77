"""A heavy top: spun fast it sleeps, slower its tip goes round in arcs, too slow it falls.

    python examples/heavy_top.py [--plot top.png]

The spin that keeps a top upright is at least 2 sqrt(m g l I1) / I3 (H. Goldstein, Classical
Mechanics, section 5.7).
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

ACROSS, ALONG = 0.032, 0.002  # moments about the tip, kg m²
TOP = lgvi.RigidBody.from_principal_moments([ACROSS, ACROSS, ALONG])
WEIGHT = lgvi.UniformGravity(mass=0.5, offset=np.array([0.0, 0.0, 0.25]))
NEEDED = 2 * np.sqrt(0.5 * 9.80665 * 0.25 * ACROSS) / ALONG  # rad/s
# Spin over the one that is needed, and how far the top leans at the start, rad.
CASES = {"sleeping": (1.5, 0.01), "nutating": (1.3, 0.5), "falling": (0.8, 0.01)}
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=1e-3, order=4)


@jax.jit
def spin(speed, lean):
    """Four seconds of the top: its axis in space, and the largest relative error of the energy."""
    R0 = lgvi.so3.exp(jnp.array([1.0, 0.0, 0.0]) * lean)
    omega0 = jnp.array([0.0, 0.0, 1.0]) * speed
    motion = INTEGRATOR.simulate(TOP, R0, omega0=omega0, steps=4000, torque=WEIGHT)
    potential = jax.vmap(WEIGHT.potential_energy)(motion.t, motion.R)
    energy = jax.vmap(TOP.energy)(motion.pi) + potential
    return motion.R[:, :, 2], jnp.max(jnp.abs(energy / energy[0] - 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw the path of the axis")
    file = parser.parse_args().plot
    print(f"a spin of {NEEDED:.0f} rad/s is needed to keep it upright; compiling ...", flush=True)
    paths = {}
    for name, (factor, lean) in CASES.items():
        axis, error = map(np.asarray, spin(factor * NEEDED, lean))
        leans, paths[name] = np.degrees(np.arccos(axis[:, 2])), axis
        print(f"{name:9} at {factor} times that: it leans by {leans.min():.1f} to "
              f"{leans.max():.1f} degrees; the energy changes by {error:.0e}")  # fmt: skip
    if file:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, 3, figsize=(8, 3), layout="constrained")
        for axis, (name, path) in zip(axes, paths.items(), strict=True):
            axis.plot(path[:, 0], path[:, 1], lw=0.8)
            axis.set(title=name, xlabel="x of the axis", aspect="equal")
        axes[0].set_ylabel("y of the axis")
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
