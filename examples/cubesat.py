"""A CubeSat in a very low orbit: what turns it, and how it flies like an arrow.

    python examples/cubesat.py [--plot cubesat.png]

The air pushes behind the centre of mass, so that the satellite swings about the direction of flight
like a weather vane: for small angles with the frequency sqrt(C rho v^2 A d / 2 J), where A is the
area of its front, d the distance from the centre of mass to the middle, and J the moment across.
Gravity gradient, sunlight and a residual magnetic dipole disturb it.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

MU, EARTH, HEIGHT = 3.986004418e14, 6.371e6, 2.5e5  # m³/s², m
RADIUS = EARTH + HEIGHT
RATE = np.sqrt(MU / RADIUS**3)  # of the orbit, rad/s
SPEED, DENSITY, DRAG = RATE * RADIUS, 6e-11, 2.2  # m/s, kg/m³
INCLINATION = np.radians(51.6)
NORMAL = np.array([0.0, -np.sin(INCLINATION), np.cos(INCLINATION)])
ACROSS = np.cross(NORMAL, [1.0, 0.0, 0.0])
EDGES = np.array([0.34, 0.1, 0.1])  # m; x points ahead
BEHIND, MASS = 0.02, 4.0  # m, kg
MOMENTS = MASS / 12 * (np.sum(EDGES**2) - EDGES**2)
SATELLITE = lgvi.RigidBody.from_principal_moments(MOMENTS)
FACETS = lgvi.Facets.of_box(EDGES, [-BEHIND, 0.0, 0.0])
DIPOLE, SUN = np.full(3, 0.005), np.array([0.3, -0.9, 0.3])  # A m²; a direction
STEP, ORBITS = 2.0, 5  # s


def up(t: jax.Array) -> jax.Array:
    """The direction from the centre of the Earth."""
    return jnp.cos(RATE * t) * jnp.array([1.0, 0, 0]) + jnp.sin(RATE * t) * jnp.asarray(ACROSS)


def position(t: jax.Array) -> jax.Array:
    return RADIUS * up(t)


def velocity(t: jax.Array) -> jax.Array:
    return SPEED * jnp.cross(jnp.asarray(NORMAL), up(t))


def field(t: jax.Array) -> jax.Array:
    """The field of a magnet along the axis of the Earth, T."""
    r, south = up(t), jnp.array([0.0, 0.0, -1.0])
    return 3.12e-5 * (EARTH / RADIUS) ** 3 * (3 * jnp.dot(south, r) * r - south)


AIR = lgvi.FreeMolecularDrag(FACETS, velocity, DENSITY, DRAG)
GRAVITY = lgvi.GravityGradient(MU, position, SATELLITE.inertia)
MAGNET = lgvi.MagneticTorque(DIPOLE, field)
SUNLIGHT = lgvi.SolarPressure(FACETS, SUN, mirrored=0.2, diffuse=0.3)
LAWS = {
    "thin air": AIR,
    "gravity gradient": GRAVITY,
    "residual dipole": MAGNET,
    "sunlight": SUNLIGHT,
}
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=STEP, order=4)


def swing() -> tuple[float, float]:
    """Small swings in a wind that does not turn: their frequency, rad/s, and that of the theory."""
    wind = lgvi.FreeMolecularDrag(FACETS, np.array([SPEED, 0.0, 0.0]), DENSITY, DRAG)
    R0, steps = lgvi.so3.exp(jnp.array([0.0, 0.0, 1e-5])), 20_000
    motion = INTEGRATOR.simulate(SATELLITE, R0, omega0=jnp.zeros(3), steps=steps, torque=wind)
    angle = np.asarray(motion.R[:, 1, 0])
    crossings = np.flatnonzero((angle[:-1] < 0) & (angle[1:] >= 0))
    part = -angle[crossings] / (angle[crossings + 1] - angle[crossings])
    ends = (crossings + part)[[0, -1]] * STEP
    measured = 2 * np.pi * (len(crossings) - 1) / (ends[1] - ends[0])
    stiffness = DRAG * DENSITY * SPEED**2 / 2 * EDGES[1] * EDGES[2] * BEHIND
    return float(measured), float(np.sqrt(stiffness / MOMENTS[2]))


@jax.jit
def fly(part: float) -> tuple[lgvi.Trajectory, jax.Array]:
    """Some orbits with a part of the dipole, and the angle from the direction of flight, rad."""
    forward = velocity(jnp.zeros(())) / SPEED
    R0 = jnp.stack([forward, jnp.asarray(NORMAL), jnp.cross(forward, jnp.asarray(NORMAL))], axis=1)
    steps = round(ORBITS * 2 * np.pi / RATE / STEP)
    torque = AIR + GRAVITY + SUNLIGHT + part * MAGNET
    omega0 = RATE * R0.T @ NORMAL
    motion = INTEGRATOR.simulate(SATELLITE, R0, omega0=omega0, steps=steps, torque=torque)
    ahead = jax.vmap(velocity)(motion.t) / SPEED
    across = jnp.linalg.norm(jnp.cross(motion.R[:, :, 0], ahead), axis=1)
    return motion, jnp.arctan2(across, jnp.sum(motion.R[:, :, 0] * ahead, axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw the angle from the flight")
    file = parser.parse_args().plot
    print("compiling ...", flush=True)
    measured, expected = swing()
    print(f"small swings: {measured:.3e} rad/s; by theory: {expected:.3e}")
    motion, angle = fly(1.0)
    _, smaller = fly(0.2)
    most, less = (float(jnp.degrees(jnp.max(x))) for x in (angle, smaller))
    print(f"angle from the flight: up to {most:.1f}, with a fifth of the dipole {less:.1f} degrees")
    for name, law in LAWS.items():
        torque = jax.vmap(law)(motion.t, motion.R)
        size = float(jnp.sqrt(jnp.mean(jnp.sum(torque**2, axis=1))))
        print(f"{name:16s} {size:.1e} N m")
    if file:
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
        orbit = np.asarray(motion.t) * RATE / (2 * np.pi)
        axis.plot(orbit, np.degrees(angle), lw=1, label="with the dipole")
        axis.plot(orbit, np.degrees(smaller), lw=1, label="with a fifth of it")
        axis.set(
            xlabel="orbits", ylabel="angle from the flight (degrees)", xlim=(0, ORBITS), ylim=0
        )
        axis.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
