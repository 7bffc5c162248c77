"""Find where the centre of mass of a tossed body is, and the shape of its inertia, from poses.

    python examples/locate_centre_of_mass.py                            twelve tosses, poses.csv
    python examples/locate_centre_of_mass.py --data FILE.csv            your recording
    python examples/locate_centre_of_mass.py --data FILE.csv --free length --plot offset.png

The file has columns `t,px,py,pz,qw,qx,qy,qz` (seconds; position of the tracked point, m, z up; unit
quaternion, scalar first, body to space) and, if it holds several tosses, `trajectory`. Keep only
what is flight. Where each toss begins need not be known.

Gravity tells whether lengths and times are right. If it does not fit, the verdict says so and names
what could be why: free the one that is in doubt with `--free`.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import lgvi
from lgvi.identification import Estimate, Model, Recordings, identify

jax.config.update("jax_enable_x64", True)

COLUMNS = {"position": ("px", "py", "pz"), "attitude": ("qw", "qx", "qy", "qz")}
GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s²
POSES = Path(__file__).with_name("poses.csv")
OFFSET = np.array([2.0, -1.0, 5.0]) * 1e-3  # m, of its tracked point from the centre of mass

# What may be in doubt, and its leaf.
SCALES = {
    "nothing": lambda model: (),
    "gravity": lambda model: (model.sensors["position"].gravity_scale,),
    "length": lambda model: (model.sensors["position"].length_scale,),
    "clock": lambda model: (model.time_scale,),
    "drag": lambda model: (model.sensors["position"].drag,),
}


def offset(model: Model) -> jax.Array:
    return model.sensors["position"].offset


def draw(estimate: Estimate, file: Path) -> None:
    """The tracked point about the centre of mass in the first toss, seen and fitted."""
    import matplotlib.pyplot as plt

    sensor = estimate.model.sensors["position"]
    t, seen = estimate.recordings[0]["position"]
    fitted, R = (estimate.predicted[name][: len(t)] for name in ("position", "attitude"))
    about = float(sensor.length_scale) * R @ np.asarray(sensor.offset)
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for k, name in enumerate("xyz"):
        axes.plot(t, 1e3 * (seen - fitted + about)[:, k], ".", color=f"C{k}")
        axes.plot(t, 1e3 * about[:, k], color=f"C{k}", label=name)
    axes.set(xlabel="time (s)", ylabel="from the centre of mass (mm)")
    axes.legend(ncols=3)
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", default=POSES, type=Path, metavar="FILE.csv", help="poses")
    parser.add_argument("--sigma", type=float, default=1e-4, help="noise of positions, m (1e-4)")
    parser.add_argument(
        "--sigma-attitude", type=float, default=1e-3, help="noise of attitudes, rad (1e-3)"
    )
    parser.add_argument("--free", choices=SCALES, default="nothing", help="what is in doubt")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the tracked point")
    arguments = parser.parse_args()
    if not (arguments.sigma > 0 and arguments.sigma_attitude > 0):
        parser.error("--sigma and --sigma-attitude must be positive")
    file = arguments.data
    try:
        recordings = Recordings.from_csv(file, comment="#", **COLUMNS)
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")
    print(f"{file.name}: {recordings}\ncompiling, then fitting ...\n", flush=True)

    loss = lgvi.Huber(3.0)
    model = Model(
        [
            lgvi.AttitudeSensor(arguments.sigma_attitude, loss=loss),
            lgvi.PositionSensor(np.zeros(3), arguments.sigma, GRAVITY, drag=0.0, loss=loss),
        ]
    )
    in_doubt = SCALES[arguments.free]
    estimate = identify(model, recordings, free=lambda m: (m.body, offset(m), *in_doubt(m)))
    estimate.report()
    if file == POSES:
        errors = (offset(estimate.model) - OFFSET) / estimate.standard_error(offset)
        print("\nerrors of the offset in standard errors:", *(f"{x:+.2f}" for x in errors))
    if arguments.plot:
        draw(estimate, arguments.plot)


if __name__ == "__main__":
    main()
