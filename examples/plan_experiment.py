"""Plan the experiment that tells most about an inertia, within the limits of the hardware.

    python examples/plan_experiment.py [throws | wheels | drone] [--plot plan.png]

Three throws before a camera, at most 6 rad/s fast; a minute of four reaction wheels that start at
rest; or a second and a half of a drone that may tilt by 0.6 rad. The planned experiment is compared
with a random one, and carried out in simulation with noise: the fit keeps what the plan promises.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import lgvi
from lgvi.identification import Limits, Model, Motors, Wheels, identify, plan, simulate_recordings

jax.config.update("jax_enable_x64", True)

HOVER = 767.0  # rad/s
AXES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])  # of the wheels


def moments(model: Model) -> Float[Array, "3"]:
    """Principal moments, kg m²."""
    return jnp.linalg.eigvalsh(model.body.inertia)


def ratios(model: Model) -> Float[Array, "3"]:
    """The moments as parts of the trace: a thrown body does not tell its size."""
    return moments(model) / jnp.trace(model.body.inertia)


def body_and_bias(model: Model) -> Any:
    """What is estimated where a gyroscope has a bias."""
    return model.body, model.sensors["angular_velocity"].bias


class Case(NamedTuple):
    """An experiment to plan."""

    model: Model
    times: Float[np.ndarray, " samples"]  # s
    limits: Limits
    options: dict[str, Any]


def throws() -> Case:
    body = lgvi.PhysicalRigidBody.from_principal_moments([2.1e-3, 3.0e-3, 4.2e-3])
    model = Model(body, lgvi.AttitudeSensor(sigma=1e-3))
    limits = Limits(rate=6.0, trajectories=3)
    return Case(model, np.arange(40) * 0.02, limits, {"quantity": ratios})


def wheels() -> Case:
    body = lgvi.PhysicalRigidBody.from_principal_moments([1.1, 1.6, 1.9])
    model = Model(body, lgvi.Gyroscope(1.6e-4, bias=np.zeros(3)))
    commands = Wheels(AXES, inertia=2e-4, speed=400.0, acceleration=40.0, start=0.0, knots=7)
    limits = Limits(rate=0.2, commands=commands)
    options = {"quantity": moments, "free": body_and_bias}
    return Case(model, np.arange(601) * 0.1, limits, options)


def drone() -> Case:
    arms = 0.0884 * np.array([[1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0]])  # m
    up = np.array([0.0, 0.0, 1.0])
    rotors = lgvi.Multirotor(
        arms, up, thrust=2.5e-6, drag=4e-8, lag=None, spin=[1, 1, -1, -1], inertia=1e-5
    )
    body = lgvi.PhysicalRigidBody.from_principal_moments([2.5e-3, 2.1e-3, 4.3e-3])
    model = Model(body, lgvi.Gyroscope(0.01), rotors=rotors)
    commands = Motors(0.6 * HOVER, 1.3 * HOVER, acceleration=8000.0, start=HOVER, knots=6)
    limits = Limits(rate=6.0, turn=0.6, commands=commands)
    return Case(model, np.arange(301) * 0.005, limits, {"quantity": moments})


CASES = {"throws": throws, "wheels": wheels, "drone": drone}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("case", nargs="?", choices=CASES, default="throws")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the plan")
    given = parser.parse_args()
    if given.plot and not given.plot.parent.is_dir():
        parser.error(f"--plot: there is no folder {given.plot.parent}")

    model, times, limits, options = CASES[given.case]()
    best = plan(model, times, limits, criterion="E", **options)
    best.report()

    recorded = simulate_recordings(model, best.recordings, best.states, key=jax.random.key(1))
    free = options.get("free", lambda model: model.body)
    estimate = identify(model, recorded, free=free, noise="given")
    quantity = options["quantity"]
    errors = (quantity(estimate.model) - quantity(model)) / best.standard_error(quantity)
    words = ", ".join(f"{error:+.2f}" for error in np.asarray(errors))
    print(f"\na fit to simulated readings is off by {words} of the standard errors of the plan")
    if given.plot:
        from lgvi.plotting import plot_plan

        plot_plan(best).savefig(given.plot, dpi=150)


if __name__ == "__main__":
    main()
