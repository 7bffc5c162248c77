"""A satellite in the gravity gradient: librating about the vertical for a hundred orbits.

    python examples/gravity_gradient.py [--plot satellite.png]

On a circular orbit a satellite whose long axis points down, and whose largest moment is about the
normal of the orbit, stays so; small librations in the plane of the orbit have the frequency
n sqrt(3 (I_roll - I_yaw) / I_pitch) (P. C. Hughes, Spacecraft Attitude Dynamics, chapter 9).
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

MU, RADIUS, ORBITS, STEPS = 3.986004418e14, 7.0e6, 100, 200  # m³/s², m; steps of an orbit
RATE = np.sqrt(MU / RADIUS**3)  # of the orbit, rad/s
# The long axis, of the smallest moment, points to the Earth; the orbit turns about z.
SATELLITE = lgvi.RigidBody.from_principal_moments([20.0, 90.0, 100.0])  # kg m²
NORMAL = np.array([0.0, 0.0, 1.0])


def position(t: jax.Array) -> jax.Array:
    return RADIUS * jnp.stack([jnp.cos(RATE * t), jnp.sin(RATE * t), jnp.zeros_like(t)])


LAW = lgvi.GravityGradient(MU, position)
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=2 * np.pi / RATE / STEPS, order=4)


@jax.jit
def fly(turn: float) -> jax.Array:
    """Angles in the plane of the orbit from the vertical, rad, for a turn at the start."""
    R0, omega0, steps = lgvi.so3.exp(NORMAL * turn), RATE * NORMAL, ORBITS * STEPS
    motion = INTEGRATOR.simulate(SATELLITE, R0, omega0=omega0, steps=steps, torque=LAW)
    angle = jnp.arctan2(motion.R[:, 1, 0], motion.R[:, 0, 0]) - RATE * motion.t
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw the librations")
    file = parser.parse_args().plot
    print("compiling ...", flush=True)
    small, large = (np.asarray(fly(turn)) for turn in (0.02, 1.0))
    crossings = np.flatnonzero((small[:-1] < 0) & (small[1:] >= 0))
    frequency = (len(crossings) - 1) / ((crossings[-1] - crossings[0]) / STEPS)
    expected = np.sqrt(3 * (90 - 20) / 100)
    print(f"librations of an orbit: {frequency:.4f}; of small ones, by theory: {expected:.4f}")
    first, last = (np.max(abs(large[part])) for part in (slice(5 * STEPS), slice(-5 * STEPS, None)))
    print(f"the large one reaches {first:.4f} rad in the first orbits, and {last:.4f} in the last")
    if file:
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
        orbit = np.arange(len(small)) / STEPS
        for label, angle in (("let go at 1 rad", large), ("let go at 0.02 rad", small)):
            axis.plot(orbit, np.degrees(angle), lw=1, label=label)
        axis.set(xlabel="orbits", ylabel="angle from the vertical (degrees)", xlim=(90, 100))
        axis.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
