"""Fit the inertia of a body to its recorded attitudes by gradient through the simulator.

    python examples/fit_inertia.py                      synthetic tosses, made by SciPy
    python examples/fit_inertia.py --data FILE.csv      your recording
    python examples/fit_inertia.py --plot fit.png       and a picture

The file has columns `t,qw,qx,qy,qz` (seconds; unit quaternion, scalar first, body to space) and,
if it holds several tosses, `trajectory`; other columns are ignored. Without torque, attitudes
determine the inertia up to a factor, so all inertias here have unit trace.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from tqdm import trange

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, initial_states

jax.config.update("jax_enable_x64", True)

# The integrator is of second order and biases the moments by an amount that falls with the
# square of this turn: about 0.2 % at 0.19 rad, less than 1e-4 at 0.02 rad.
LARGEST_TURN_PER_STEP = 0.02  # rad

QUATERNION = ("qw", "qx", "qy", "qz")
# For initial rates only, which do not depend on this inertia and this noise.
CAMERA = Model(lgvi.PhysicalRigidBody.from_principal_moments(np.ones(3)), lgvi.AttitudeSensor(1.0))


def synthetic_tosses(
    tosses: int, noise: float, seed: int, duration: float = 2.0, samples: int = 100
) -> tuple[Recordings, np.ndarray]:
    """Attitudes of a tumbling body from Euler's equations, integrated by DOP853.

    Returns the recordings, with `noise` (rad per axis) on every attitude, and the true
    inertia, of unit trace.
    """
    random = np.random.default_rng(seed)
    axes = Rotation.from_rotvec([0.4, -0.7, 0.5]).as_matrix()
    J = axes @ np.diag([0.20, 0.36, 0.44]) @ axes.T
    inverse = np.linalg.inv(J)

    def motion(_, state):
        w, v, omega = state[0], state[1:4], state[4:]
        rates = inverse @ np.cross(J @ omega, omega)
        return np.concatenate([[-v @ omega / 2], (w * omega + np.cross(v, omega)) / 2, rates])

    recorded = []
    t = np.linspace(0, duration, samples)
    for _ in range(tosses):
        omega = random.normal(size=3)
        omega *= random.uniform(2, 4) / np.linalg.norm(omega)
        start = np.concatenate([Rotation.random(rng=random).as_quat(scalar_first=True), omega])
        states = solve_ivp(
            motion, (0, duration), start, method="DOP853", t_eval=t, rtol=1e-12, atol=1e-12
        ).y.T
        disturbance = Rotation.from_rotvec(noise * random.normal(size=(samples, 3)))
        attitudes = Rotation.from_quat(states[:, :4], scalar_first=True) * disturbance
        recorded.append(Recordings.from_arrays(t, attitude=attitudes))
    return Recordings.concatenate(recorded), J


class Recorded(NamedTuple):
    """Tosses side by side: a padded sample repeats the last time, so its step has size zero."""

    t: np.ndarray  # (tosses, samples), s
    value: np.ndarray  # (tosses, samples, 3, 3)
    mask: np.ndarray  # (tosses, samples), False where padded


def attitudes_of(recordings: Recordings) -> Recorded:
    samples = recordings.channels["attitude"]
    return Recorded(samples.t, samples.value, samples.mask)


class Tosses(eqx.Module):
    """Unknowns of the fit: one inertia, and the initial state of every toss."""

    body: lgvi.PhysicalRigidBody
    offset: Float[Array, "tosses 3"]  # from the first recorded attitude to the true one, rad
    turn: Float[Array, "tosses 3"]  # initial angular velocity times duration, rad

    def attitudes(self, recorded: Recorded, substeps: int) -> Float[Array, "tosses samples 3 3"]:
        """Simulate every toss at the recorded times."""

        def one(offset, turn, t, R):
            omega = turn / (t[-1] - t[0])
            integrator = lgvi.MoserVeselovIntegrator(jnp.repeat(jnp.diff(t) / substeps, substeps))
            start = R[0] @ lgvi.so3.exp(offset)
            trajectory = integrator.simulate(self.body, start, self.body.angular_momentum(omega))
            return trajectory.R[::substeps]

        return jax.vmap(one)(self.offset, self.turn, recorded.t, recorded.value)

    def residuals(self, recorded: Recorded, substeps: int) -> Float[Array, "tosses samples 3"]:
        """Rotation vectors from simulated to recorded attitudes, rad; zero where padded."""
        error = jnp.swapaxes(self.attitudes(recorded, substeps), -1, -2) @ recorded.value
        return jax.vmap(jax.vmap(lgvi.so3.log))(error) * recorded.mask[..., None]


def largest_turn(recorded: Recorded) -> float:
    """The largest rotation between two samples of a toss, rad."""
    between = np.swapaxes(recorded.value[:, :-1], -1, -2) @ recorded.value[:, 1:]
    return float(np.max(Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude()))


def steps_per_sample(turn: float) -> int:
    return max(1, int(np.ceil(turn / LARGEST_TURN_PER_STEP)))


@eqx.filter_jit
def initial_guess(recorded: Recorded, states: InitialStates, inertia: np.ndarray | Array) -> Tosses:
    duration = recorded.t[:, -1:] - recorded.t[:, :1]
    return Tosses(
        lgvi.PhysicalRigidBody.from_inertia(inertia),
        offset=jnp.zeros_like(states.omega),
        turn=jnp.asarray(states.omega) * duration,
    )


def loss(model: Tosses, recorded: Recorded, substeps: int) -> tuple[Array, Array]:
    """Mean square of the residuals, and the residuals."""
    residuals = model.residuals(recorded, substeps)
    # In units of 1 mrad, so that the optimiser meets numbers of order one.
    return jnp.sum((1e3 * residuals) ** 2) / (3 * jnp.sum(recorded.mask)), residuals


# One program for loss, gradient and residuals, also used where only residuals are needed.
evaluate = eqx.filter_jit(eqx.filter_value_and_grad(loss, has_aux=True))
OPTIMISER: Any = optax.lbfgs(memory_size=30)  # optax's types leave modules out


@eqx.filter_jit
def update(model: Tosses, state: Any, recorded: Recorded, substeps: int):
    """One iteration: the model, the state of the optimiser, and the loss."""
    # Value and gradient come from the last line search: the program contains the loss only once.
    known = {name: optax.tree.get(state, name) for name in ("value", "grad")}
    step, state = OPTIMISER.update(
        known["grad"], state, model, **known, value_fn=lambda m: loss(m, recorded, substeps)[0]
    )
    return eqx.apply_updates(model, step), state, optax.tree.get(state, "value")


def fit(model: Tosses, recorded: Recorded, substeps: int, iterations: int) -> Tosses:
    """Least squares by L-BFGS, until the loss no longer falls."""
    (value, _), gradient = evaluate(model, recorded, substeps)
    state = optax.tree.set(eqx.filter_jit(OPTIMISER.init)(model), value=value, grad=gradient)
    # Optax starts some counters weakly typed; made strict, `update` compiles once, not twice.
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), state)
    values = []
    with trange(iterations, desc="fit", unit="iteration", leave=False) as progress:
        for _ in progress:
            model, state, value = update(model, state, recorded, substeps)
            values.append(float(value))
            progress.set_postfix(rms=f"{values[-1] ** 0.5:.4f} mrad", refresh=False)
            if len(values) > 20 and values[-20] - values[-1] < 1e-7 * values[-1]:
                print(f"fit: settled after {len(values)} iterations")
                return model
    print(f"fit: NOT settled after {iterations} iterations; take more --iterations")
    return model


@eqx.filter_jit
def unit_inertia(model: Tosses) -> Float[Array, "3 3"]:
    return model.body.inertia / jnp.trace(model.body.inertia)


def residual_per_axis(residuals: Array, recorded: Recorded) -> tuple[float, np.ndarray]:
    """Root mean square, mrad, of all tosses and of each toss, corrected for fitted parameters."""
    squares = np.sum((1e3 * np.asarray(residuals)) ** 2, axis=(1, 2))
    freedom = 3 * np.sum(recorded.mask, axis=1) - 6
    return np.sqrt(np.sum(squares) / (np.sum(freedom) - 5)), np.sqrt(squares / freedom)


def plot(file: Path, recorded: Recorded, residuals: dict[str, Array]) -> None:
    import matplotlib.pyplot as plt

    kept = recorded.mask
    since = (recorded.t - recorded.t[:, :1])[kept]
    figure, axes = plt.subplots(1, len(residuals), figsize=(10, 3.8), layout="constrained")
    for axis, (title, values) in zip(axes, residuals.items(), strict=True):
        for component, name in zip(1e3 * np.asarray(values)[kept].T, "xyz", strict=True):
            axis.plot(since, component, ".", ms=2, alpha=0.6, label=f"body {name}")
        axis.set(title=title, xlabel="time since the start of the toss (s)")
    axes[0].set_ylabel("recorded against simulated\nattitude (mrad)")
    axes[-1].legend(markerscale=5, loc="upper right")
    figure.savefig(file, dpi=150)
    print(f"picture: {file}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--data", type=Path, metavar="FILE.csv", help="recorded attitudes")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a picture")
    parser.add_argument(
        "--drop-above",
        type=float,
        metavar="FACTOR",
        help="fit again without trajectories whose residual exceeds FACTOR times the median",
    )
    parser.add_argument("--iterations", type=int, default=500, help="at most, of the optimiser")
    parser.add_argument("--tosses", type=int, default=8, help="number of synthetic tosses")
    parser.add_argument("--seed", type=int, default=0, help="seed of the synthetic tosses")
    arguments = parser.parse_args()
    if arguments.tosses < 1 or arguments.iterations < 1:
        parser.error("--tosses and --iterations must be at least 1")
    if arguments.drop_above is not None and arguments.drop_above < 1:
        parser.error("--drop-above must be at least 1")
    if arguments.plot and not arguments.plot.parent.is_dir():
        parser.error(f"--plot: there is no folder {arguments.plot.parent}")
    started = time.perf_counter()

    if arguments.data is None:
        recordings, truth = synthetic_tosses(arguments.tosses, noise=1e-3, seed=arguments.seed)
        start = np.diag([0.45, 0.25, 0.30])
        wrong = np.linalg.norm(start - truth) / np.linalg.norm(truth)
        print(f"start: an inertia that is {wrong:.0%} wrong (Frobenius norm)")
    else:
        try:
            recordings, truth = Recordings.from_csv(arguments.data, attitude=QUATERNION), None
        except (OSError, ValueError) as problem:
            parser.exit(2, f"{problem}\n")
        start = np.eye(3) / 3
        print("start: an isotropic inertia")
    print(f"data: {recordings}")

    recorded = attitudes_of(recordings)
    turn = largest_turn(recorded)
    substeps = steps_per_sample(turn)
    print(f"step: {substeps} for each sample, of at most {turn / substeps:.3f} rad")

    guess = initial_guess(recorded, initial_states(CAMERA, recordings), start)
    model = fit(guess, recorded, substeps, arguments.iterations)
    if arguments.drop_above is not None:
        (_, residuals), _ = evaluate(model, recorded, substeps)
        _, each = residual_per_axis(residuals, recorded)
        outside = each > arguments.drop_above * np.median(each)
        names = [name for name, out in zip(recordings.names, outside, strict=True) if out]
        recordings = recordings.drop(names, f"above {arguments.drop_above:g} times the median")
        print(f"data: {recordings}")
        recorded = attitudes_of(recordings)
        guess = initial_guess(recorded, initial_states(CAMERA, recordings), unit_inertia(model))
        model = fit(guess, recorded, substeps, arguments.iterations)
    (_, residuals), _ = evaluate(model, recorded, substeps)

    moments = np.linalg.eigvalsh(unit_inertia(model))
    print("estimated moments (unit trace):", *(f"{moment:.5f}" for moment in moments))
    print("their ratio to the mean:       ", *(f"{3 * moment:.5f}" for moment in moments))
    if truth is not None:
        true_moments = np.linalg.eigvalsh(truth)
        print("true moments:                  ", *(f"{moment:.5f}" for moment in true_moments))
        print("relative errors:               ", *(f"{e:+.3%}" for e in moments / true_moments - 1))
    noise = "" if truth is None else ", simulated noise 1 mrad"
    all_tosses, each = residual_per_axis(residuals, recorded)
    print(f"residual per axis: {all_tosses:.3f} mrad{noise}")
    if outliers := int(np.sum(each > 2.5 * np.median(each))):
        print(f"note: {outliers} trajectories exceed 2.5 times the median; see --drop-above")
    print(f"wall time: {time.perf_counter() - started:.1f} s")
    if arguments.plot:
        first = initial_guess(recorded, initial_states(CAMERA, recordings), start)
        (_, before), _ = evaluate(first, recorded, substeps)
        residuals = {"start": before, "fit": residuals}
        plot(arguments.plot, recorded, residuals)


if __name__ == "__main__":
    main()
