"""The flat spin: why a long satellite does not keep its spin about its long axis.

    python examples/flat_spin.py [--plot flat_spin.png]

Explorer 1, launched in 1958, was spun about its long axis, and tumbled after some hours: what bends
or sloshes in a body takes energy from its motion, and not momentum, so that it ends about the axis
of the largest moment, where the energy is least. Here a wheel on a shaft with friction takes it.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

MOMENTS = np.array([0.1, 5.0, 5.2])  # kg m²; x is the long axis
WHEEL, FRICTION = 0.05, 0.4  # kg m², N m s
SPIN, NUTATION = 2 * np.pi * 1.25, np.radians(1)  # rad/s, a tenth of that of Explorer 1; rad
BODY = lgvi.DampedBody(np.diag(MOMENTS), np.array([0.0, 0.0, 1.0]), WHEEL, FRICTION)
STEP, STEPS, STORED = 0.02, 1_000_000, 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw the angle and the energy")
    file = parser.parse_args().plot
    print("compiling ...", flush=True)
    momentum = MOMENTS[0] * SPIN
    pi0 = momentum * np.array([np.cos(NUTATION), np.sin(NUTATION), 0.0])
    motion = BODY.simulate(np.eye(3), pi0, dt=STEP, steps=STEPS, save_every=STEPS // STORED)
    angle = np.degrees(np.arccos(np.clip(abs(motion.pi[:, 0]) / momentum, 0, 1)))
    energy = np.asarray(jax.vmap(BODY.energy)(motion.pi, motion.spin))
    in_space = jnp.einsum("nij,nj->ni", motion.R, motion.pi)
    change = float(jnp.max(jnp.linalg.norm(in_space - in_space[0], axis=1))) / momentum
    print(f"momentum in space changes by {change:.0e} of it in {STEPS:,} steps")
    print(f"energy rises in {np.sum(np.diff(energy) > 1e-12 * energy[0])} of {STORED} intervals")
    hours = np.asarray(motion.t) / 3600
    print(
        f"the long axis is 45 degrees from the momentum after {hours[np.argmax(angle > 45)]:.1f} h"
    )
    end, least = energy[-1], momentum**2 / (2 * MOMENTS[2])
    print(f"energy at the end: {end:.6f} J; the least for this momentum: {least:.6f} J")
    if file:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
        axes[0].plot(hours, angle, lw=1)
        axes[0].set(xlabel="hours", ylabel="angle of the long axis\nfrom the momentum (degrees)")
        axes[1].plot(hours, energy, lw=1, color="tab:orange")
        axes[1].set(xlabel="hours", ylabel="energy (J)", ylim=0)
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
