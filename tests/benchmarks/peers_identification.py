"""Fits of the inertia to ten throws by lgvi, `mujoco.sysid` and SciPy: each by its documented way.

Each fit gives the principal moments over their sum, and intervals of 95 %. The body of `fit_...`
from its second line on is what a user writes, and its lines are counted.
"""

import inspect
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

import lgvi
from lgvi.identification import Model, Recordings, identify

SIGMA_R, SIGMA_OMEGA = 0.01, 0.02  # rad, rad/s


class Throws(NamedTuple):
    """What was recorded, and what only the peers are told that need it."""

    t: np.ndarray  # (samples,), s
    R: np.ndarray  # (throws, samples, 3, 3)
    omega: np.ndarray  # (throws, samples, 3), rad/s
    true_states: tuple[np.ndarray, np.ndarray]  # (throws, 3, 3) and (throws, 3), at the start


class Fitted(NamedTuple):
    """Principal moments over their sum, falling, and the ends of their intervals."""

    moments: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def fit_lgvi(throws: Throws) -> Fitted:
    """Initial states are unknown."""
    sensors = [lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_OMEGA)]
    log = Recordings.concatenate(
        Recordings.from_arrays(throws.t, attitude=R, angular_velocity=omega)
        for R, omega in zip(throws.R, throws.omega, strict=True)
    )
    estimate = identify(Model(sensors), log)

    def ratios(model):
        return jnp.linalg.eigvalsh(model.body.inertia) / jnp.trace(model.body.inertia)

    return Fitted(ratios(estimate.model), *estimate.interval(ratios))


def has_sysid() -> bool:
    """Whether MuJoCo's identification is installed with what it needs."""
    is_there = find_spec("mujoco.sysid") is not None
    return is_there and hasattr(import_module("mujoco.sysid"), "optimize")


def fit_sysid(throws: Throws, states: tuple[np.ndarray, np.ndarray], is_weighted: bool) -> Fitted:
    """Initial states are given, as its trajectories begin there; steps of Runge-Kutta 4.

    By default it divides residuals by the size of the readings; weighted, by their noise.
    """
    sysid: Any = import_module("mujoco.sysid")
    mujoco: Any = import_module("mujoco")
    spec = mujoco.MjSpec.from_string("""
    <mujoco>
      <option gravity="0 0 0" timestep="0.005" integrator="RK4"/>
      <worldbody><body name="box">
        <joint name="spin" type="ball"/>
        <inertial pos="0 0 0" mass="1" fullinertia="0.33 0.33 0.34 0 0 0"/>
      </body></worldbody>
    </mujoco>""")

    def inertia(x):
        xx, yy, xy, xz, yz = x
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, 1 - xx - yy]])

    def put(spec, parameter):
        J = inertia(parameter.value)
        box = spec.body("box")
        box.explicitinertial = True
        box.fullinertia = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]

    parameters = sysid.ParameterDict()
    start, lower, upper = [0.33, 0.33, 0, 0, 0], [0.1, 0.1, *[-0.1] * 3], [0.49, 0.49, *[0.1] * 3]
    parameters.add(sysid.Parameter("inertia", start, lower, upper, modifier=put))
    model = spec.compile()
    kinds = sysid.SignalType  # of states, as sensors would be those of the step before
    signals = {
        "spin_qpos": (kinds.MjStateQPos, np.arange(4)),
        "spin_qvel": (kinds.MjStateQVel, np.arange(4, 7)),
    }
    starts, controls, readings = [], [], []
    for R, omega, R0, omega0 in zip(throws.R, throws.omega, *states, strict=True):
        q = Rotation.from_matrix(R).as_quat(scalar_first=True)
        first = Rotation.from_matrix(R0).as_quat(scalar_first=True)
        for k in range(len(q)):  # q and -q are one attitude, but differences are not
            q[k] *= np.sign(q[k] @ (q[k - 1] if k else first))
        starts.append(sysid.create_initial_state(model, first, omega0))
        controls.append(sysid.TimeSeries(throws.t, np.zeros((len(throws.t), 0)), {}))
        readings.append(sysid.TimeSeries(throws.t, np.hstack([q, omega]), signals))
    numbers = [str(k) for k in range(len(starts))]
    sequences = sysid.ModelSequences(
        "throws", spec, numbers, starts, controls, readings, allow_missing_sensors=True
    )

    def by_noise(_, __, measured, *___, state, **____):
        size = np.repeat([SIGMA_R / 2, SIGMA_OMEGA], [4, 3])  # of a quaternion, and of rates
        predicted = sysid.TimeSeries(state[:, 0], state[:, 1:], signals).resample(measured.times)
        return (measured.data - predicted.data) / size, predicted, measured

    residual = sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=by_noise if is_weighted else None
    )
    best, result = sysid.optimize(parameters, residual, verbose=False)
    residuals, _, _ = residual(result.x, best)
    covariance, _ = sysid.calculate_intervals(residuals, result.jac)
    freedom = sum(x.size for x in residuals) - 5
    return _of_moments(inertia, result.x, covariance, freedom)


def fit_scipy(throws: Throws) -> Fitted:
    """Initial states are unknown: the first readings are where the fit starts."""
    count, samples = throws.R.shape[:2]
    first = Rotation.from_matrix(throws.R[:, 0])
    recorded = Rotation.from_matrix(throws.R.reshape(-1, 3, 3))

    def inertia(x):
        xx, yy, xy, xz, yz = x
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, 1 - xx - yy]])

    def slope(_, y, J, inverse):
        q, omega = y.reshape(2, -1)[:, : 4 * count].reshape(2, count, 4)
        w, v, omega = q[:, :1], q[:, 1:], omega[:, :3]
        turn = np.hstack([-np.sum(v * omega, 1, keepdims=True), w * omega + np.cross(v, omega)])
        change = np.cross(omega @ J, omega) @ inverse
        return np.stack([turn / 2, np.hstack([change, np.zeros((count, 1))])]).ravel()

    def residual(x):
        J, states = inertia(x[:5]), x[5:].reshape(count, 6)
        q = (first * Rotation.from_rotvec(states[:, :3])).as_quat(scalar_first=True)
        y0 = np.stack([q, np.hstack([states[:, 3:], np.zeros((count, 1))])]).ravel()
        arguments = J, np.linalg.inv(J)
        solution = solve_ivp(
            slope, throws.t[[0, -1]], y0, "DOP853", throws.t, args=arguments, rtol=1e-8, atol=1e-8
        )
        q, omega = np.moveaxis(solution.y.reshape(2, count, 4, samples), 3, 2)
        turns = Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).inv() * recorded
        of_rates = (throws.omega - omega[..., :3]) / SIGMA_OMEGA
        return np.concatenate([turns.as_rotvec().ravel() / SIGMA_R, of_rates.ravel()])

    states = np.hstack([np.zeros((count, 3)), throws.omega[:, 0]]).ravel()
    one = np.kron(np.eye(count), np.ones((3 * samples, 6)))  # each throw has its own state
    sparsity = np.hstack([np.ones((6 * samples * count, 5)), np.vstack([one, one])])
    start = np.concatenate([[0.33, 0.33, 0, 0, 0], states])
    result = least_squares(residual, start, jac_sparsity=sparsity, x_scale="jac")
    freedom, jacobian = len(result.fun) - len(start), result.jac.toarray()
    variance = result.fun @ result.fun / freedom
    covariance = variance * np.linalg.inv(jacobian.T @ jacobian)[:5, :5]
    return _of_moments(inertia, result.x[:5], covariance, freedom)


def _of_moments(inertia: Callable, x: np.ndarray, covariance: np.ndarray, freedom: int) -> Fitted:
    """The delta method, by differences."""
    moments = np.linalg.eigvalsh(inertia(x))
    steps = 1e-6 * np.eye(len(x))
    slopes = [
        np.linalg.eigvalsh(inertia(x + s)) - np.linalg.eigvalsh(inertia(x - s)) for s in steps
    ]
    slopes = np.array(slopes).T / 2e-6
    half = np.sqrt(np.diag(slopes @ covariance @ slopes.T)) * student.ppf(0.975, freedom)
    return Fitted(moments, moments - half, moments + half)


FITS: dict[str, Callable[[Throws], Fitted]] = {
    "lgvi": fit_lgvi,
    "SciPy": fit_scipy,
    "mujoco.sysid, true initial states": lambda x: fit_sysid(x, x.true_states, False),
    "mujoco.sysid, weighted by the noise": lambda x: fit_sysid(x, x.true_states, True),
    "mujoco.sysid, first readings": lambda x: fit_sysid(x, (x.R[:, 0], x.omega[:, 0]), False),
}
LINES = {"lgvi": fit_lgvi, "SciPy": fit_scipy, "mujoco.sysid": fit_sysid}


def count_lines(fit: Callable[..., Any]) -> int:
    """Lines of code of a fit, with those of the moments where it has none of its own."""
    functions = [fit] if fit is fit_lgvi else [fit, _of_moments]
    source = "".join(inspect.getsource(function) for function in functions)
    return sum(bool(line.strip()) for line in source.splitlines()) - 2 * len(functions)
