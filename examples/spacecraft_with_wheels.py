"""Plan and carry out an experiment that weighs a spacecraft by its reaction wheels.

    python examples/spacecraft_with_wheels.py [--star-tracker] [--rate 500] [--plot wheels.png]

A torque-free spacecraft has a gyroscope of unknown bias, and three wheels whose momentum is
recorded. While the wheels rest, no reading depends on the size of the inertia: twice the inertia
with twice the momentum moves alike. When the wheels speed up and slow down, the body answers with a
momentum that is known, and the size of the inertia becomes observable. The example computes this
before there are any data, then simulates the experiment, and identifies inertia and bias from the
noisy readings.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identifiability,
    identify,
    simulate_recordings,
)

jax.config.update("jax_enable_x64", True)

MOMENTS = np.array([1.1, 1.6, 1.9])  # kg m²
AXES = lgvi.so3.exp(jnp.array([0.1, -0.2, 0.15]))  # principal axes, not along the wheel axes
TRUE = lgvi.PhysicalRigidBody.from_principal_moments(MOMENTS, AXES)
BIAS = jnp.array([1e-3, -2e-3, 1.5e-3])  # rad/s
NOISE_DENSITY = 5e-5  # rad/s/sqrt(Hz), of a small gyroscope: 0.17 degrees per root hour
STAR_NOISE = jnp.array([5e-5, 5e-5, 3e-4])  # rad, worst about the line of sight
STAR_RATE, WHEEL_RATE = 2, 10  # Hz
DURATION = 30.0  # s
STATE = InitialStates.from_rates(np.array([[0.01, -0.015, 0.02]]))  # rad/s
WHEEL_MOMENTUM = 0.06  # kg m²/s, at most
PERIODS = np.array([10.0, 15.0, 30.0])  # s, period of the manoeuvre of each wheel


def layout(rate: int, star_tracker: bool, manoeuvre: bool) -> Recordings:
    """The times of all readings and the momenta of the wheels; the readings are placeholders."""
    t, wheels, stars = (
        np.linspace(0, DURATION, round(DURATION * each) + 1)
        for each in (rate, WHEEL_RATE, STAR_RATE)
    )
    momentum = manoeuvre * WHEEL_MOMENTUM * np.sin(2 * np.pi * wheels[:, None] / PERIODS)
    return Recordings.from_arrays(
        attitude=(stars, np.tile(np.eye(3), (len(stars), 1, 1))) if star_tracker else None,
        angular_velocity=(t, np.zeros((len(t), 3))),
        rotor_momentum=(wheels, momentum),
    )


def sensors_with(bias: ArrayLike, rate: int, star_tracker: bool) -> list:
    gyroscope = lgvi.Gyroscope(NOISE_DENSITY * rate**0.5, bias=bias)
    return [gyroscope, lgvi.AttitudeSensor(STAR_NOISE)] if star_tracker else [gyroscope]


def free(model: Model):
    """The unknown leaves of the model."""
    return model.body, model.sensors["angular_velocity"].bias


def quantities(model: Model) -> Float[Array, "9"]:
    """Entries of the inertia, kg m², and the bias, rad/s."""
    J = model.body.inertia
    return jnp.concatenate([J[jnp.triu_indices(3)], model.sensors["angular_velocity"].bias])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rate", type=int, default=100, help="rate of the gyroscope, Hz (100)")
    parser.add_argument("--star-tracker", action="store_true", help="add a star tracker")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw readings and fit")
    given = parser.parse_args()
    if given.rate < 1:
        parser.error("--rate must be at least 1")
    if given.plot and not given.plot.parent.is_dir():
        parser.error(f"--plot: there is no folder {given.plot.parent}")

    rate, stars = given.rate, given.star_tracker
    truth = Model(TRUE, sensors_with(BIAS, rate, stars))
    at_rest, manoeuvre = (layout(rate, stars, moving) for moving in (False, True))
    for heading, plan in (("wheels at rest", at_rest), ("wheel manoeuvre", manoeuvre)):
        print(f"\nplan: {heading}, expected accuracy at the true values ...\n", flush=True)
        identifiability(truth, plan, STATE, free=free).report()

    print(
        "\nidentified from simulated readings of the manoeuvre, the bias unknown ...\n", flush=True
    )
    recorded = simulate_recordings(truth, manoeuvre, STATE, key=jax.random.key(0))
    start = Model(sensors_with(np.zeros(3), rate, stars))
    # The simulated noise is independent from reading to reading, as the plan takes it.
    estimate = identify(start, recorded, free=free, errors="independent")
    estimate.report()

    names = ["Jxx", "Jxy", "Jxz", "Jyy", "Jyz", "Jzz", "bias x", "bias y", "bias z"]
    true, found = (np.asarray(quantities(model)) for model in (truth, estimate.model))
    errors = (found - true) / np.asarray(estimate.standard_error(quantities))
    print("\n        true        found    error in standard errors")
    for row in zip(names, true, found, errors, strict=True):
        print("{:6}{:>10.6f}{:>13.6f}{:>+12.2f}".format(*row))
    if given.plot:
        from lgvi.plotting import plot_fit

        plot_fit(estimate).savefig(given.plot, dpi=150)


if __name__ == "__main__":
    main()
