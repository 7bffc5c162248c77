"""Chaos and the limits of identification: a moon like Hyperion tumbles, and nobody can say how.

    python examples/chaos.py [--plot chaos.png]

Its orbit is an ellipse and its moments differ much, so that its rotation is chaotic (J. Wisdom, S.
Peale, F. Mignard, Icarus 58 (1984), doi:10.1016/0019-1035(84)90032-0). Two starts that differ
by 1e-9 rad part by a factor of e in each Lyapunov time. The derivative of the attitude with respect
to a moment grows alike: a long record tells the moments very well, if the fit begins near enough.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

ECCENTRICITY, ORBITS, STEPS = 0.1, 28, 400  # steps of an orbit; the unit of time is 1 / mean motion
MOMENTS = jnp.array([0.736, 0.9, 1.0])  # (I2 - I1) / I3 is about 0.16, in the plane of the orbit
APART = 1e-9  # rad


def position(t):
    """On the ellipse, from Kepler's equation by Newton's method."""
    anomaly = t
    for _ in range(6):
        excess = anomaly - ECCENTRICITY * jnp.sin(anomaly) - t
        anomaly = anomaly - excess / (1 - ECCENTRICITY * jnp.cos(anomaly))
    minor = np.sqrt(1 - ECCENTRICITY**2)
    x, y = jnp.cos(anomaly) - ECCENTRICITY, minor * jnp.sin(anomaly)
    return jnp.stack([x, y, jnp.zeros_like(t)])


LAW = lgvi.GravityGradient(1.0, position)
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=2 * np.pi / STEPS, order=4)


def tumble(moments, turn):
    moon = lgvi.RigidBody(jnp.diag(moments))
    R0 = lgvi.so3.exp(jnp.array([0.1, 0.05, 0.3]) + turn * jnp.array([0.0, 0.0, 1.0]))
    omega0, steps = jnp.array([0.1, 0.05, 1.2]), ORBITS * STEPS
    return INTEGRATOR.simulate(moon, R0, omega0=omega0, steps=steps, torque=LAW).R


@jax.jit
def part():
    """The angle between two starts, and how fast attitudes move with the smallest moment, rad."""

    def motion(turn):
        return jax.jvp(lambda moments: tumble(moments, turn), (MOMENTS,), (jnp.eye(3)[0],))

    R, slope = jax.vmap(motion)(jnp.array([0.0, APART]))
    angles = jax.vmap(lgvi.so3.distance)(R[0], R[1])
    return angles, jnp.linalg.norm(slope[0], axis=(1, 2)) / np.sqrt(2)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw how motions part")
    file = parser.parse_args().plot
    print("compiling ...", flush=True)
    apart, slope = map(np.asarray, part())
    orbit = np.arange(len(apart)) / STEPS
    grown = slice(2 * STEPS, int(np.argmax(np.append(apart, 1) > 0.1)))
    rate = np.polyfit(orbit[grown], np.log(apart[grown]), 1)[0]
    print(f"motions part by a factor of e in {1 / rate:.2f} orbits")
    print(f"from {APART:.0e} rad they are 0.1 rad apart after {orbit[grown.stop - 1]:.1f} orbits")
    print(f"derivative of the attitude by a moment: {slope[STEPS]:.1e} rad after one orbit, "
          f"{slope[-1]:.1e} after {ORBITS}")  # fmt: skip
    if file:
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
        axis.semilogy(orbit, apart, label=f"angle between two starts, {APART:.0e} rad apart")
        axis.semilogy(orbit, slope, label="derivative of the attitude by a moment")
        axis.set(xlabel="orbits", ylabel="rad", ylim=(APART / 10, None))
        axis.legend(frameon=False)
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
