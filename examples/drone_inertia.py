"""Identify a drone's inertia, drag and motor lag from a log of rates and motor commands.

    python examples/drone_inertia.py [--plot rates.png]                simulated flights
    python examples/drone_inertia.py --data LOG.csv --arm 0.12 --thrust 3e-6

The log has columns `t,wx,wy,wz,m1,m2,m3,m4` (seconds; rad/s, body frame, z up; speeds or commands
of the motors, rad/s) and, if it holds several flights, `trajectory`. The drone is a square one. Its
motors are in front to the left, in front to the right, behind to the right and behind to the left,
with x forward. Thrust is known from a test bench; without it, only ratios could be known.

The simulated drone flies under a rate controller, which turns it to a new rate twice a second.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import Model, Recordings, identify

jax.config.update("jax_enable_x64", True)

COLUMNS = {"angular_velocity": ("wx", "wy", "wz"), "rotor_speed": ("m1", "m2", "m3", "m4")}
UP, SPIN = np.array([0.0, 0.0, 1.0]), (1, -1, 1, -1)
SIGMA = 0.01  # rad/s

# The simulated flights.
MOMENTS = np.array([3.1e-3, 3.6e-3, 5.9e-3])  # kg m²
DRAG, LAG, SPUN, WEIGHT = 4.5e-8, 0.035, 2e-5, 5.0  # N m s², s, kg m², N
FLIGHTS, SAMPLES, DT, PARTS, GAIN = 3, 500, 0.004, 4, 25.0


def rotors(arguments, drag, lag, inertia) -> lgvi.Multirotor:
    arms = arguments.arm * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    return lgvi.Multirotor(arms, UP, arguments.thrust, drag, lag, SPIN, inertia)


@jax.jit
def fly(drone: lgvi.Multirotor, targets: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rates and commands (samples, ...) of a flight, with a target of the rate at each sample."""
    J = jnp.diag(MOMENTS)
    to_torques = jax.jacobian(drone.torque)(jnp.ones(4)) / 2  # of the squares of the speeds
    mixer = jnp.linalg.inv(jnp.vstack([to_torques, jnp.full(4, drone.thrust)]))
    integrator = lgvi.MoserVeselovIntegrator(DT / PARTS)
    ramp = jnp.linspace(0, 1, PARTS + 1)[:, None]

    def sample(state, target):
        R, pi, speed, command = state
        omega = jnp.linalg.solve(J, pi - drone.momentum(speed))
        wanted = jnp.append(J @ (GAIN * (target - omega)), WEIGHT)
        following = jnp.sqrt(jnp.clip(mixer @ wanted, 2e5, 4e6))
        commands = command + ramp * (following - command)
        lagging = replace(drone, behind=command - speed)
        speeds = lagging.follow(commands, jnp.full(PARTS, DT / PARTS))
        h = jax.vmap(drone.momentum)(speeds)
        body = lgvi.Gyrostat(J, (h[1:] + h[:-1]) / 2)
        torques = jax.vmap(drone.torque)(speeds)
        motion = integrator.simulate(body, R, pi, body_torques=torques)
        return (motion.R[-1], motion.pi[-1], speeds[-1], following), (omega, command)

    hover = jnp.full(4, jnp.sqrt(WEIGHT / 4 / drone.thrust))
    start = jnp.eye(3), drone.momentum(hover), hover, hover
    return jax.lax.scan(sample, start, targets)[1]


def made_up(arguments) -> Recordings:
    random, drone = np.random.default_rng(0), rotors(arguments, DRAG, LAG, SPUN)
    flights, t = [], np.arange(SAMPLES) * DT
    for number in range(FLIGHTS):
        targets = random.normal(size=(SAMPLES // 125, 3)) * [4, 4, 2]  # rad/s
        rates, commands = map(np.asarray, fly(drone, np.repeat(targets, 125, 0)))
        rates = rates + SIGMA * random.normal(size=rates.shape)
        log = Recordings.from_arrays(
            t, angular_velocity=rates, rotor_speed=commands, name=str(number)
        )
        flights.append(log)
    return Recordings.concatenate(flights)


def numbers(model) -> dict[str, jax.Array]:
    drone = model.rotors
    return {
        "moments (1e-3 kg m²)": 1e3 * jnp.linalg.eigvalsh(model.body.inertia),
        "drag (1e-8 N m s²)": 1e8 * drone.drag[None],
        "spin inertia (1e-5 kg m²)": 1e5 * drone.inertia[None],
        "lag (ms)": 1e3 * drone.lag[None],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, metavar="LOG.csv", help="a log")
    parser.add_argument("--arm", type=float, default=0.12, help="of a motor along x and y, m")
    parser.add_argument("--thrust", type=float, default=3e-6, help="thrust over speed², N s²")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the rates and the fit")
    arguments = parser.parse_args()
    if not (arguments.arm > 0 and arguments.thrust > 0):
        parser.error("--arm and --thrust must be positive")
    try:
        if arguments.data is None:
            log = made_up(arguments)
        else:
            log = Recordings.from_csv(arguments.data, **COLUMNS)
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")

    body = lgvi.PhysicalRigidBody.from_principal_moments([4e-3, 4e-3, 4e-3])
    start = Model(body, lgvi.Gyroscope(SIGMA), rotors=rotors(arguments, 1e-8, 0.02, 1e-6))

    def free(model):
        drone, gyroscope = model.rotors, model.sensors["angular_velocity"]
        return model.body, drone.drag, drone.lag, drone.inertia, gyroscope.bias

    print(
        f"{arguments.data or 'simulated flights'}: {log}\ncompiling, then fitting ...\n", flush=True
    )
    estimate = identify(start, log, free=free)
    estimate.report()
    if arguments.data is None:
        truth = [1e3 * MOMENTS, [1e8 * DRAG], [1e5 * SPUN], [1e3 * LAG]]
        found, errors = numbers(estimate.model), estimate.standard_error(numbers)
        print("\n                                true  identified  in standard errors")
        for (name, values), true in zip(found.items(), truth, strict=True):
            for a, b, c in zip(true, values, errors[name], strict=True):
                print(f"{name:26} {a:9.4f}  {b:10.4f}  {(b - a) / c:+.2f}")
    if arguments.plot:
        from lgvi.plotting import plot_fit

        plot_fit(estimate).savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
