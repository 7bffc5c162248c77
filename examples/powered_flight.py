"""Identify a quadrotor's mass, its inertia and where its IMU is, from a log of powered flight.

    python examples/powered_flight.py [--plot flight.png]              simulated flights
    python examples/powered_flight.py --data LOG.csv --arm 0.12 --thrust 3e-6

The log has columns `t,wx,wy,wz,ax,ay,az,x,y,z,m1,m2,m3,m4` (seconds; rad/s and, of the
accelerometer, m/s², body frame, z up; position of a mark, m, space frame, z up; speeds of the
motors, rad/s) and, if it holds several flights, `trajectory`. Cells may be empty where a sensor has
no reading. The drone is a square one. Its motors are in front to the left, in front to the right,
behind to the right and behind to the left, with x forward. Thrust is known from a test bench.

A part of the flights is not fitted: the model has to predict it. NumPy alone simulates the flights,
in a wind that the model does not know.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import FittedPart, Model, Recordings, identify

jax.config.update("jax_enable_x64", True)

COLUMNS = {
    "angular_velocity": ("wx", "wy", "wz"),
    "specific_force": ("ax", "ay", "az"),
    "position": ("x", "y", "z"),
    "rotor_speed": ("m1", "m2", "m3", "m4"),
}
SIGMA = {"angular_velocity": 0.01, "specific_force": 0.1, "position": 0.002}  # rad/s, m/s², m
LABELS = {
    "angular_velocity": "rate (rad/s)",
    "specific_force": "specific force (m/s²)",
    "position": "position (m)",
}
SQUARE = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
UP, GRAVITY, SPIN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -9.81]), (1, -1, 1, -1)

# The simulated flights.
ARM, THRUST, LAG = 0.12, 3e-6, 0.035  # m, N s², s
MASS, MOMENTS = 0.5, np.array([3.1e-3, 3.6e-3, 5.9e-3])  # kg, kg m²
IMU, MARK = np.array([0.03, -0.02, 0.01]), np.array([0.02, 0.0, 0.05])  # m, from centre of mass
DRAG, SPUN = 4.5e-8, 2e-5  # of the rotors, N m s² and kg m²
FRAME, IN_PLANE, WIND = 0.1, 2e-5, 0.1  # N s/m, N s²/m, m/s
FLIGHTS, SAMPLES, BEFORE, DT, PARTS = 12, 250, 125, 0.004, 2
TRUTH = {
    "moments (1e-3 kg m²)": 1e3 * MOMENTS,
    "mass (kg)": [MASS],
    "place of the IMU (mm)": 1e3 * IMU,
    "place of the mark (mm)": 1e3 * MARK,
    "rotor drag (1e-8 N m s²)": [1e8 * DRAG],
    "spin inertia (1e-5 kg m²)": [1e5 * SPUN],
    "drag of the frame (N s/m)": [FRAME],
    "in-plane drag (1e-5 N s²/m)": [1e5 * IN_PLANE],
}

# Torque and thrust (4,) of the squares of the speeds.
ARMS = ARM * SQUARE
MIXER = np.stack([THRUST * ARMS[:, 1], -THRUST * ARMS[:, 0], -DRAG * np.array(SPIN), 4 * [THRUST]])


def waves(random, size, slow, fast) -> Callable[[float], np.ndarray]:
    """Vectors (flights, 3) that change with time: sums of sines, of root mean square `size`."""
    shape = FLIGHTS, 3, 8
    rate, phase = random.uniform(slow, fast, shape), random.uniform(0, 2 * np.pi, shape)
    return lambda t: size / 2 * np.sin(rate * t + phase).sum(-1)


def fly(random) -> list[np.ndarray]:
    """What a log has (flights, samples, ...), in the sequence of `COLUMNS`, without noise."""
    target, turn = waves(random, 0.4, 2, 8), waves(random, 1.5, 1, 5)  # m, rad/s
    wind = waves(random, WIND, 2, 12)

    def parts(state):
        x, v, R, omega, speeds = np.split(state, [3, 6, 15, 18], axis=1)
        return x, v, R.reshape(-1, 3, 3), omega, speeds

    def in_body(R, vectors):
        return np.einsum("nji,nj->ni", R, vectors)

    def command(t, state):
        """Speeds (flights, 4) with which a controller follows the target, and turns."""
        x, v, R, omega, _ = parts(state)
        pull = MASS * (5 * (target(t) - x) - 3.5 * v - GRAVITY)
        along = np.sum(pull * R[:, :, 2], axis=1)
        tilt = np.cross(R[:, :, 2], pull) / np.linalg.norm(pull, axis=1, keepdims=True)
        alpha = 100 * in_body(R, tilt) + np.array([14, 14, 5]) * (turn(t) * UP - omega)
        squares = np.column_stack([MOMENTS * alpha, along]) @ np.linalg.inv(MIXER).T
        return np.sqrt(np.clip(squares, 1e5, 1.2e6))

    def change(t, state):
        """The derivative of the state, and what the accelerometer feels (flights, 3)."""
        _, v, R, omega, speeds = parts(state)
        speeding = (command(t, state) - speeds) / LAG
        of_rotors = speeds**2 @ MIXER.T
        u = in_body(R, v - wind(t))
        drag = FRAME * u + IN_PLANE * speeds.sum(1, keepdims=True) * u * (1 - UP)
        force = (of_rotors[:, 3:] * UP - drag) / MASS
        momentum = MOMENTS * omega + SPUN * (speeds @ SPIN)[:, None] * UP
        brake = np.cross(omega, momentum) + SPUN * (speeding @ SPIN)[:, None] * UP
        alpha = (of_rotors[:, :3] - brake) / MOMENTS
        R_rate = np.cross(R, omega[:, None, :]).reshape(-1, 9)  # R hat(omega)
        v_rate = np.einsum("nij,nj->ni", R, force) + GRAVITY
        felt = force + np.cross(alpha, IMU) + np.cross(omega, np.cross(omega, IMU))
        return np.hstack([v, v_rate, R_rate, alpha, speeding]), felt

    hover = np.full(4, np.sqrt(-MASS * GRAVITY[2] / 4 / THRUST))
    at_rest = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3), hover])
    state = np.hstack([target(0.0), np.tile(at_rest, (FLIGHTS, 1))])
    samples, h = [], DT / PARTS
    for step in range(PARTS * (BEFORE + SAMPLES)):
        t = step * h
        k1, felt = change(t, state)
        if step >= PARTS * BEFORE and step % PARTS == 0:
            x, _, R, omega, speeds = parts(state)
            samples.append((omega, felt, x + R @ MARK, speeds))
        k2, _ = change(t + h / 2, state + h / 2 * k1)  # Runge and Kutta's method
        k3, _ = change(t + h / 2, state + h / 2 * k2)
        k4, _ = change(t + h, state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return [np.stack(of_quantity, axis=1) for of_quantity in zip(*samples, strict=True)]


def made_up() -> Recordings:
    random, t, flights = np.random.default_rng(0), DT * np.arange(SAMPLES), []
    for number, values in enumerate(zip(*fly(random), strict=True)):
        log = {
            name: value + SIGMA.get(name, 0.0) * random.normal(size=value.shape)
            for name, value in zip(COLUMNS, values, strict=True)
        }
        flights.append(Recordings.from_arrays(t, name=str(number), **log))
    return Recordings.concatenate(flights)


def free(model):
    imu, mark = model.sensors["specific_force"], model.sensors["position"]
    drone, air = model.rotors, model.force
    of_air = drone.drag, drone.inertia, air.linear, drone.in_plane_drag
    return model.body, model.mass, imu.position, mark.offset, *of_air


def numbers(model) -> dict[str, jax.Array]:
    """The numbers of `TRUTH`, of a model."""
    body, mass, imu, mark, drag, spun, frame, in_plane = free(model)
    values = (
        1e3 * jnp.linalg.eigvalsh(body.inertia),
        mass[None],
        1e3 * imu,
        1e3 * mark,
        1e8 * drag[None],
        1e5 * spun[None],
        frame[None],
        1e5 * in_plane[None],
    )
    return dict(zip(TRUTH, values, strict=True))


def draw(flight: FittedPart, file: Path) -> None:
    """A flight that was not fitted, as it was recorded and as the model predicts it."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, sharex=True, figsize=(6, 5.5), layout="constrained")
    for axis, (channel, label) in zip(axes, LABELS.items(), strict=True):
        t, recorded = flight.recordings[0][channel]
        some = slice(None, None, 1 + len(t) // 30)
        for k, name in enumerate("xyz"):
            axis.plot(t[some], recorded[some, k], ".", color=f"C{k}", markersize=4)
            axis.plot(t, flight.predicted[channel][: len(t), k], color=f"C{k}", label=name)
        axis.set_ylabel(label)
    axes[0].set_title("a flight that was not fitted: recorded (dots), predicted (lines)")
    axes[0].legend(ncols=3)
    axes[-1].set_xlabel("time (s)")
    figure.savefig(file, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, metavar="LOG.csv", help="a log")
    parser.add_argument("--arm", type=float, default=ARM, help="of a motor along x and y, m")
    parser.add_argument("--thrust", type=float, default=THRUST, help="thrust over speed², N s²")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the prediction")
    arguments = parser.parse_args()
    if not (arguments.arm > 0 and arguments.thrust > 0):
        parser.error("--arm and --thrust must be positive")
    try:
        if arguments.data is None:
            log = made_up()
        else:
            log = Recordings.from_csv(arguments.data, **COLUMNS)
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")

    arms, thrust = arguments.arm * SQUARE, arguments.thrust
    start = Model(
        lgvi.PhysicalRigidBody.from_principal_moments([4e-3, 4e-3, 4e-3]),
        [
            lgvi.Gyroscope(SIGMA["angular_velocity"]),
            lgvi.Accelerometer(np.zeros(3), SIGMA["specific_force"]),
            lgvi.PositionSensor(0.03 * UP, SIGMA["position"]),  # the mark is somewhere above
        ],
        rotors=lgvi.Multirotor(arms, UP, thrust, drag=2e-8, lag=None, spin=SPIN, inertia=1e-5),
        mass=0.65,
        force=lgvi.AirDrag(0.05),
        gravity=GRAVITY,
    )
    fitted, kept = log.hold_out(0.2)
    print(
        f"{arguments.data or 'simulated flights'}: {log}\ncompiling, then fitting ...\n", flush=True
    )
    estimate = identify(start, fitted, free=free)
    estimate.report()
    validation = estimate.validate(kept)
    print(f"\n{validation}")
    if arguments.data is None:
        values, errors = numbers(estimate.model), estimate.standard_error(numbers)
        lower, upper = estimate.interval(numbers)
        print(f"\n{'true':>36}  identified   95 % interval         in standard errors")
        for name, true in TRUTH.items():
            of_name = (true, values[name], lower[name], upper[name], errors[name])
            for a, b, low, high, error in zip(*of_name, strict=True):
                span = f"{low:8.4f} to {high:8.4f}"
                print(f"{name:27} {a:8.4f}  {b:10.4f}  {span:20}  {(b - a) / error:+.2f}")
    if arguments.plot:
        draw(validation.parts[""], arguments.plot)


if __name__ == "__main__":
    main()
