"""Weigh an object with a device that has a flywheel: mass properties with errors, for MuJoCo.

    python examples/weigh_by_flywheel.py [--model object.xml] [--plot object.png]
    python examples/weigh_by_flywheel.py --data ALONE.csv PROOF.csv OBJECT.csv

A device with a gyroscope, an accelerometer and a flywheel is tossed alone, with a proof body that
is known, and with the object. The masses are known from a scale. One fit finds all else: the
inertia and the centre of mass of the device, the spin inertia of its flywheel, the biases of its
sensors, and the inertia and the centre of mass of the object, with errors that include those of
all others. It takes about a minute.

The files have columns `t,wx,wy,wz,ax,ay,az,wheel` (seconds; angular velocity, rad/s, and specific
force, m/s², in the axes of the device; speed of the flywheel, rad/s) and, if a file holds several
tosses, `trajectory`. Keep only what is flight. The constants at the top of the script describe the
device and the bodies.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identify_jointly,
    simulate_recordings,
)

jax.config.update("jax_enable_x64", True)

COLUMNS = {
    "angular_velocity": ("wx", "wy", "wz"),
    "specific_force": ("ax", "ay", "az"),
    "rotor_momentum": ("wheel",),
}
DEVICE, OBJECT = 0.25, 0.18  # kg
PLACE = np.array([0.03, -0.02, 0.01])  # of the accelerometer in the device's frame, m
# A cylinder of steel on the device.
PROOF = lgvi.MassProperties.cylinder(0.2, radius=0.015, length=0.036).moved([0.0, 0.05, 0.02])
AXIS = np.array([0.0, 0.0, 1.0])  # of the flywheel
SPEED = 500.0  # of the flywheel at the start, rad/s
TOSSES = 10  # of each configuration
T = np.arange(100) * 0.005  # s

TRUTH = {
    "device": lgvi.PhysicalRigidBody.from_principal_moments([2.1e-4, 3.0e-4, 3.6e-4]),
    "device centre": jnp.array([2e-3, -1e-3, 3e-3]),  # m
    "object": lgvi.PhysicalRigidBody.from_principal_moments([0.8e-4, 1.3e-4, 1.7e-4]),
    "object centre": jnp.array([-4e-3, 0.055, 0.012]),
    "wheel": jnp.array(4e-6),  # kg m²
    "rate bias": jnp.array([0.01, -0.02, 0.03]),  # rad/s
    "force bias": jnp.array([0.2, -0.1, 0.15]),  # m/s²
}
START = {
    "device": lgvi.PhysicalRigidBody.from_principal_moments([3e-4, 3e-4, 3e-4]),
    "device centre": jnp.zeros(3),
    "object": lgvi.PhysicalRigidBody.from_principal_moments([2e-4, 2e-4, 2e-4]),
    "object centre": jnp.array([0.0, 0.05, 0.0]),
    "wheel": jnp.array(2e-6),
    "rate bias": jnp.zeros(3),
    "force bias": jnp.zeros(3),
}


def device(p) -> lgvi.MassProperties:
    return lgvi.MassProperties(DEVICE, p["device centre"], p["device"].inertia)


def weighed(p) -> lgvi.MassProperties:
    """The object, in the device's frame."""
    return lgvi.MassProperties(OBJECT, p["object centre"], p["object"].inertia)


def model_of(p, whole: lgvi.MassProperties) -> Model:
    """The device as it flies, with what it carries."""
    sensors = [
        lgvi.Gyroscope(5e-3, bias=p["rate bias"]),
        lgvi.Accelerometer(PLACE - whole.centre, 0.05, bias=p["force bias"]),
    ]
    return Model(lgvi.RigidBody(whole.inertia), sensors, rotor_inertia=p["wheel"] * AXIS)


CONFIGURATIONS = {
    "alone": lambda p: model_of(p, device(p)),
    "with the proof body": lambda p: model_of(p, device(p) + PROOF),
    "with the object": lambda p: model_of(p, device(p) + weighed(p)),
}


def fly(model: Model, key: int) -> Recordings:
    """Tosses while the flywheel runs down."""
    speed = SPEED * np.exp(-T)
    nothing = dict.fromkeys(("angular_velocity", "specific_force"), np.zeros((len(T), 3)))
    toss = Recordings.from_arrays(T, **nothing, rotor_momentum=speed)
    omega = 6 * np.random.default_rng(key).normal(size=(TOSSES, 3))
    plan, states = Recordings.concatenate([toss] * TOSSES), InitialStates.from_rates(omega)
    return simulate_recordings(model, plan, states, key=jax.random.key(key))


LABELS = {
    "moments (1e-4 kg m²)": ("smallest", "middle", "largest"),
    "centre of mass (mm)": ("x", "y", "z"),
}


def numbers(p) -> dict[str, jax.Array]:
    """What is asked for, in units that are read well."""
    found = weighed(p)
    values = 1e4 * found.principal().moments, 1e3 * found.centre
    return dict(zip(LABELS, values, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    files = ("ALONE.csv", "PROOF.csv", "OBJECT.csv")
    parser.add_argument("--data", nargs=3, type=Path, metavar=files, help="recorded tosses")
    parser.add_argument("--model", type=Path, metavar="FILE.xml", help="write a MuJoCo model")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the errors")
    arguments = parser.parse_args()
    if arguments.data and arguments.plot:
        parser.error("--plot needs the truth, so it does not go with --data")
    models = CONFIGURATIONS.values()
    try:
        if arguments.data:
            tosses = [Recordings.from_csv(file, **COLUMNS) for file in arguments.data]
        else:
            tosses = [fly(model(TRUTH), key) for key, model in enumerate(models, 3)]
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")

    parts = dict(zip(CONFIGURATIONS, zip(models, tosses, strict=True), strict=True))
    for name, (_, recordings) in parts.items():
        print(f"{name}: {recordings}")
    print("compiling, then fitting ...\n", flush=True)
    estimate = identify_jointly(START, parts)
    estimate.report()
    found, true = numbers(estimate.parameters), None if arguments.data else numbers(TRUTH)
    errors, (lower, upper) = estimate.standard_error(numbers), estimate.interval(numbers)
    print("\nobject                             value  std. error       95 % interval")
    for name, labels in LABELS.items():
        for k, label in enumerate(labels):
            line = f"{name:20} {label:8} {found[name][k]:10.4f}  {errors[name][k]:10.4f}"
            line += f"  {lower[name][k]:8.4f} to {upper[name][k]:7.4f}"
            print(line if true is None else f"{line}   truth {true[name][k]:7.4f}")
    element = weighed(estimate.parameters).to_mjcf()
    print(f"\n{element}")
    if arguments.model:
        body = f'<body name="object"><freejoint/>{element}</body>'
        text = f"<mujoco><worldbody>{body}</worldbody></mujoco>\n"
        arguments.model.write_text(text, encoding="utf-8")
        print(f"model: {arguments.model}")
    if arguments.plot:
        draw(found, true, (lower, upper), arguments.plot)


def draw(found, true, interval, file: Path) -> None:
    """How far each number is from the truth, with its interval."""
    import matplotlib.pyplot as plt

    lower, upper = interval
    figure, axes = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
    for ax, (name, labels) in zip(axes, LABELS.items(), strict=True):
        bars = np.stack([found[name] - lower[name], upper[name] - found[name]])
        ax.errorbar(labels, found[name] - true[name], bars, fmt="o", capsize=4)
        ax.axhline(0, color="gray", linewidth=0.8)
        ax.set(title=name, ylabel="estimate less truth", xlim=(-0.5, 2.5))
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
