"""Identify the shape of an inertia from recorded attitudes in a file, with error bars.

    python examples/identify_real_attitudes.py                     forty throws, throws.csv
    python examples/identify_real_attitudes.py --data FILE.csv     your recording
    python examples/identify_real_attitudes.py --data FILE.csv --drop --plots FOLDER

The file has columns `t,qw,qx,qy,qz` (seconds; unit quaternion, scalar first, body to space) and,
if it holds several trajectories, `trajectory`; other columns are ignored. Without torque, attitudes
determine the inertia up to a factor, so moments are parts of its trace.

The loss is robust, so that a few bad readings do not decide the fit. With `--drop` the trajectories
that do not fit are left out, and the others are fitted again; both fits are reported.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import lgvi
from lgvi.identification import Estimate, Model, Recordings, identify

jax.config.update("jax_enable_x64", True)

THROWS = Path(__file__).with_name("throws.csv")  # two of them are spoilt
TRUTH = np.array([0.25, 0.35, 0.40])


def moments(model: Model) -> Float[Array, "3"]:
    """Principal moments as parts of the trace, rising."""
    J = model.body.inertia
    return jnp.linalg.eigvalsh(J / jnp.trace(J))


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
    parser.add_argument("--data", default=THROWS, type=Path, metavar="FILE.csv", help="attitudes")
    parser.add_argument("--sigma", type=float, default=5e-4, help="expected noise, rad (5e-4)")
    parser.add_argument("--drop", action="store_true", help="drop bad trajectories, fit again")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="write pictures")
    arguments = parser.parse_args()
    if not arguments.sigma > 0:
        parser.error("--sigma must be positive")
    if arguments.plots and arguments.plots.exists() and not arguments.plots.is_dir():
        parser.error(f"--plots: {arguments.plots} is no folder")
    file, columns = arguments.data, ("qw", "qx", "qy", "qz")
    try:
        recordings = Recordings.from_csv(file, attitude=columns, comment="#")
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")
    print(f"{file.name}: {recordings}\ncompiling, then fitting ...\n", flush=True)

    sensor = lgvi.AttitudeSensor(arguments.sigma, loss=lgvi.Huber(3.0))
    estimate = identify(Model(sensor), recordings)
    estimate.report()
    if arguments.drop and estimate.outliers:
        kept = recordings.drop(estimate.outliers, "does not fit")
        print("\nfit without these trajectories\n")
        estimate = identify(Model(estimate.body, sensor), kept)
        estimate.report()
    if file == THROWS:
        ratios = (moments(estimate.model) - TRUTH) / estimate.standard_error(moments)
        print("\nerrors of the moments in standard errors:", *(f"{x:+.2f}" for x in ratios))
    if arguments.plots:
        draw(estimate, arguments.plots)


if __name__ == "__main__":
    main()
