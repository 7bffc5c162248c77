"""Identify the shape of an inertia from recorded attitudes in a file, with error bars.

    python examples/identify_real_attitudes.py                               simulated tosses
    python examples/identify_real_attitudes.py --data FILE.csv               your recording
    python examples/identify_real_attitudes.py --data FILE.csv --drop --plots FOLDER

The file has columns `t,qw,qx,qy,qz` (seconds; unit quaternion, scalar first, body to space) and,
if it holds several trajectories, `trajectory`; other columns are ignored. Without torque, attitudes
determine the inertia up to a factor, so moments are parts of its trace.

The loss is robust, so that a few bad readings do not decide the fit. With `--drop` the trajectories
that do not fit are left out, and the others are fitted again; both fits are reported.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import lgvi
from lgvi.identification import (
    Estimate,
    InitialStates,
    Model,
    Recordings,
    identify,
    simulate_recordings,
)

jax.config.update("jax_enable_x64", True)

QUATERNION = ("qw", "qx", "qy", "qz")
ISOTROPIC = lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3))  # start of the fit

# The simulated recording: short tosses, some with a jump of the attitude.
MOMENTS = np.array([0.25, 0.35, 0.40])  # of unit sum
TOSSES, SAMPLES, RATE, SPEED = 40, 15, 148.0, 4.0  # samples per toss; Hz; rad/s
SPOILT = [7, 23]
JUMP = jnp.array([0.0, 0.02, 0.0])  # rad, as when a camera loses a marker


def moments(model: Model) -> Float[Array, "3"]:
    """Principal moments as parts of the trace, rising."""
    J = model.body.inertia
    return jnp.linalg.eigvalsh(J / jnp.trace(J))


def made_up(sigma: float, seed: int) -> Recordings:
    random = np.random.default_rng(seed)
    directions = random.normal(size=(TOSSES, 3))
    omega = SPEED * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    states = InitialStates(jax.vmap(lgvi.so3.exp)(directions), jnp.asarray(omega))
    body = lgvi.PhysicalRigidBody.from_principal_moments(MOMENTS)
    t, sensor = np.arange(SAMPLES) / RATE, lgvi.AttitudeSensor(sigma)
    made = simulate_recordings(Model(body, sensor), t, states, key=jax.random.key(seed))
    attitude = made.channels["attitude"].value.copy()
    attitude[SPOILT, SAMPLES // 2 :] @= np.asarray(lgvi.so3.exp(JUMP))
    return eqx.tree_at(
        lambda made: made.channels["attitude"].values, made, attitude.reshape(-1, 3, 3)
    )


def draw(estimate: Estimate, folder: Path) -> None:
    from lgvi import plotting

    folder.mkdir(parents=True, exist_ok=True)
    for plot in (plotting.plot_residuals, plotting.plot_fit, plotting.plot_moments):
        file = folder / f"{plot.__name__.removeprefix('plot_')}.png"
        try:
            plot(estimate).savefig(file, dpi=150)
            print(f"picture: {file}")
        except ValueError as problem:  # moments that are not observable cannot be drawn
            print(f"no picture {file}: {problem}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, metavar="FILE.csv", help="recorded attitudes")
    parser.add_argument("--sigma", type=float, default=5e-4, help="expected noise, rad (5e-4)")
    parser.add_argument("--drop", action="store_true", help="drop bad trajectories, fit again")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="write pictures")
    arguments = parser.parse_args()
    if not arguments.sigma > 0:
        parser.error("--sigma must be positive")
    if arguments.plots and arguments.plots.exists() and not arguments.plots.is_dir():
        parser.error(f"--plots: {arguments.plots} is no folder")
    try:
        if arguments.data is None:
            recordings = made_up(arguments.sigma, seed=0)
        else:
            recordings = Recordings.from_csv(arguments.data, attitude=QUATERNION)
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")
    print(f"{arguments.data or 'simulated tosses'}: {recordings}\n\nfit of all\n")

    sensor = lgvi.AttitudeSensor(arguments.sigma, loss=lgvi.Huber(3.0))
    estimate = identify(Model(ISOTROPIC, sensor), recordings)
    estimate.report()
    if arguments.drop and estimate.outliers:
        kept = recordings.drop(estimate.outliers, "does not fit")
        print("\nfit without these trajectories\n")
        estimate = identify(Model(estimate.body, sensor), kept)
        estimate.report()
    if arguments.data is None:
        error = np.asarray(moments(estimate.model)) - MOMENTS
        ratios = error / np.asarray(estimate.standard_error(moments))
        print("\nerrors of the moments in standard errors:", *(f"{x:+.2f}" for x in ratios))
    if arguments.plots:
        draw(estimate, arguments.plots)


if __name__ == "__main__":
    main()
