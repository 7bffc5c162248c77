"""Initial states from the first samples of windows, and states to try without such samples."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy.spatial.transform import Rotation

from ...modules.sensors.sensor import require_fields, states_of
from ..checks import require_sensors
from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..model.free_leaves import ravel, unravel
from ..model.model import Model
from ..model.states import InitialStates, state_leaves
from ..running.progress import show_progress
from ..segments.levels import FEWEST_SAMPLES, SHORTEST_TURN
from ..segments.segment import Window, whole_trajectories
from .measured import Measured, angles_between, attitude_about, largest_rates, measurer_of

TURNS = 8  # about a vector
# About a vector, over the speed across.
RATES = 0.0, 0.4, -0.4, 0.8, -0.8, 1.5, -1.5, 3.0, -3.0

SPOILT = 20  # times the usual square, from which a value is not fitted
HALF_TURN = 2.8  # rad, pi less a margin for noise
LEAP = 3  # times the usual turn, the most that a turn between readings counts
MOST_COMPARED = 32  # attitudes of a window, to find a central attitude
AT_ONCE = 1000  # windows whose first attitudes are in memory


class Trials(NamedTuple):
    """The unknown part of the state of each window."""

    unknown: np.ndarray  # (windows,), whether no reading tells the attitude
    # (windows, 3), a unit vector in the body frame, about which the turn is not known; or zero.
    axis: np.ndarray
    turning: np.ndarray  # (windows, 3), the part of the rate that this turn reverses
    turns: np.ndarray  # (windows,), whether readings depend on this turn
    rate: np.ndarray  # (windows,), whether the rate about this vector is not known
    speed: np.ndarray  # (windows,), rad/s
    told: np.ndarray  # (windows,), whether readings tell the motion of the trajectory

    @property
    def any(self) -> bool:
        """Whether there are states to try."""
        return bool(np.any(self.unknown) or np.any(self.axis))

    def choose(
        self, costs: Callable[[InitialStates], np.ndarray], states: InitialStates
    ) -> InitialStates:
        """Of the states that are tried, those with the least `costs` (windows,)."""
        best, least = states, costs(states)
        for trial in self._tried(states):
            values = np.asarray(costs(trial))
            better = np.flatnonzero(values < least)
            best, least = best.put(better, trial.at(better)), np.fmin(least, values)
        return best

    def _tried(self, states: InitialStates) -> Iterator[InitialStates]:
        dtype = states.omega.dtype
        if np.any(self.unknown):
            for R in Rotation.create_group("O").as_matrix().astype(dtype):
                yield replace(states, R=np.where(self.unknown[:, None, None], R, states.R))
        if not np.any(self.axis):
            return
        turns = np.arange(TURNS if np.any(self.turns) else 1) * (2 * np.pi / TURNS)
        rates = RATES if np.any(self.axis[self.rate]) else (0.0,)
        for turn in turns:
            about = Rotation.from_rotvec(turn * self.turns[:, None] * self.axis)
            R = states.R @ about.as_matrix()
            across = states.omega - self.turning + about.inv().apply(self.turning)
            for rate in rates:
                along = (rate * self.speed * self.rate)[:, None] * self.axis
                yield replace(states, R=R.astype(dtype), omega=(across + along).astype(dtype))


@show_progress("initial_states")
def initial_states(model: Model, recordings: Recordings) -> InitialStates:
    """Initial states of all trajectories, computed from their first samples.

    The angular velocity is that of a gyroscope if there is one, else the derivative of a polynomial
    through attitudes. Good to some per cent, if the body turns much less than half a turn between
    two samples. Two directions give attitudes; one direction gives the attitude except for a turn
    about it, and the rate across it. An unknown attitude is the identity, and an unknown rate zero.
    The state of a sensor, such as a position, is in `own`.

    Parameters
    ----------
    model
        The model, with a sensor for each channel of the recordings.
    recordings
        What was recorded.

    Returns
    -------
    InitialStates
        The states at the first reading of each trajectory.

    Raises
    ------
    ValueError, TypeError
        If sensors and recorded channels differ.
    """
    require_sensors(model, recordings)
    speeds = largest_rates(model, recordings)
    return jax.device_put(guess_states(model, recordings, whole_trajectories(recordings), speeds))


def guess_states(
    model: Model, recordings: Recordings, windows: Sequence[Window], speeds: np.ndarray
) -> InitialStates:
    """States at the first reading of each window; see `guess_with_trials`."""
    return guess_with_trials(model, recordings, windows, speeds)[0]


def guess_with_trials(
    model: Model, recordings: Recordings, windows: Sequence[Window], speeds: np.ndarray
) -> tuple[InitialStates, Trials]:
    """States at the first reading of each window, from the readings within `SHORTEST_TURN`.

    Also the unknown parts, which are to be tried. Windows of a trajectory are consecutive.
    `speeds` (trajectories,) are the largest rates.
    """
    time_scale, durations = float(model.time_scale), SHORTEST_TURN / np.maximum(speeds, 1e-300)
    measure, read = measurer_of(model), recordings.reader()
    states, beginnings, own, trials = [], [], [], []
    places = _places_of_own(model)
    for trajectory, group in groupby(windows, lambda window: window.trajectory):
        samples = read(trajectory)  # perhaps from a file, so once
        measured = measure(samples)
        told = bool(measured.attitudes or measured.rates or measured.vectors)
        for window in group:
            duration = durations[trajectory]
            about = _about_vector(measured, window, duration, time_scale)
            if about:
                R, omega, axis, turning, moves = about
                beginnings.append(_Beginning(np.zeros(1), R[None], 0.0, omega))
            else:
                axis, turning, moves = np.zeros(3), np.zeros(3), False
                beginnings.append(_beginning(measured, window, duration))
            if len(beginnings) == AT_ONCE:
                states.append(_states(beginnings, time_scale))
                beginnings = []
            if places is not None:
                own.append(_guess_own(model, *places, samples, measured.t, window, duration))
            unknown = about is None and _is_unknown(measured, window)
            # Where a vector of space does not move, all turns about it look alike.
            others = sum(_first_in([pair], window, 0.0) is not None for pair in measured.others)
            turns = moves or others > 1 or model.torque is not None
            rate = _first_in(measured.rates, window, 0.0) is None
            speed = speeds[trajectory] / time_scale
            trials.append((unknown, axis, turning, turns, rate, speed, told))
    if beginnings:
        states.append(_states(beginnings, time_scale))
    dtype = jax.dtypes.canonicalize_dtype(float)
    R, omega = (np.concatenate(part).astype(dtype) for part in zip(*states, strict=True))
    start = InitialStates(R, omega, np.stack(own).astype(dtype) if own else None)
    return start, Trials(*(np.stack(column) for column in zip(*trials, strict=True)))


def _places_of_own(model: Model) -> tuple[np.ndarray, Any] | None:
    """The states of sensors as one vector (m,), and a model with the index of each number in it.

    None for a model without states.
    """
    states = state_leaves(model)
    if states is None:
        return None
    leaves = eqx.filter(model, states)
    values = ravel(leaves)
    places = np.arange(len(values), dtype=float)
    return values, unravel(jax.tree.map(np.asarray, leaves), places)


def _guess_own(
    model: Model,
    values: np.ndarray,
    places: Any,
    samples: OfTrajectory,
    times: np.ndarray,
    window: Window,
    duration: float,
) -> np.ndarray:
    """Other states at the first reading of a window (m,): from the model, or guessed.

    `times` are the times of all readings, `duration` that of the readings of which the motion of
    the centre of mass is guessed.
    """
    guessed, start = values.copy(), times[np.searchsorted(times, window.begin)]
    centre: dict[str, np.ndarray] = {}
    for channel, sensor in model.sensors.items():
        t, readings = samples[channel]
        part = slice(np.searchsorted(t, window.begin), np.searchsorted(t, window.end, "right"))
        if not len(t[part]):
            continue
        since = (t[part] - start) * float(model.time_scale)
        if model.gravity is not None:
            # Over twice the time that the first reading is late, or a polynomial would run away.
            last = max(duration * float(model.time_scale), since[:FEWEST_SAMPLES][-1], 2 * since[0])
            near = since <= last
            x, v = sensor.guess_motion(readings[part][near])
            if x is not None:  # the velocity too, unless a sensor reads it
                centre = dict(zip(("x0", "v0"), _polynomial(since[near], x), strict=False)) | centre
            if v is not None:
                centre["v0"] = _polynomial(since[near], v)[0]
        if not states_of(sensor):
            continue
        fields = sensor.guess_fields(since, readings[part])
        require_fields(sensor, fields)
        for field, value in fields.items():
            at = np.asarray(getattr(places.sensors[channel], field)).astype(int)
            guessed[at.ravel()] = np.ravel(value)
    for name, value in centre.items():
        guessed[np.asarray(getattr(places, name)).astype(int)] = value
    return guessed


def _is_unknown(measured: Measured, window: Window) -> bool:
    """Whether readings of a window depend on the attitude, but no reading gives it."""
    attitude, other = (
        _first_in(pairs, window, 0.0) for pairs in (measured.attitudes, measured.others)
    )
    return attitude is None and other is not None


def _about_vector(
    measured: Measured, window: Window, duration: float, time_scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, bool] | None:
    """The state of a window in which one vector gives the attitude, except for a turn about it.

    Attitude (3, 3) and rate (3,), rad/s, of one turn and without a rate about the vector, if
    no sensor gives the rate; the unit vector (3,); the part of the rate (3,) that another turn
    about the vector reverses; and whether the vector moves in space.
    """
    vectors = _first_in(measured.vectors, window, duration)
    if vectors is None or _first_in(measured.attitudes, window, 0.0) is not None:
        return None
    start = measured.t[np.searchsorted(measured.t, window.begin)]
    t, values = vectors
    coefficients = _polynomial(t - t[0], values)
    first, change = coefficients[0], np.zeros(6)
    if len(coefficients) > 1:
        change = coefficients[1] / time_scale
    in_body, in_space = (x / np.linalg.norm(x) for x in (first[:3], first[3:]))
    R = attitude_about(in_body, in_space)
    if (rates := _first_in(measured.rates, window, duration)) is not None:
        omega, turning = _polynomial(rates[0] - start, rates[1])[0], np.zeros(3)
    else:
        turning = np.cross(in_body, R.T @ change[3:])
        omega = turning - np.cross(in_body, change[:3])
    back = Rotation.from_rotvec(omega * ((start - t[0]) * time_scale))  # rates may begin before
    moves = bool(np.ptp(values[:, 3:], axis=0).any())
    return R @ back.as_matrix(), omega, back.inv().apply(in_body), turning, moves


def _first_in(
    pairs: list[tuple[np.ndarray, np.ndarray]], window: Window, duration: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """The first readings in a window, of the first sensor with readings there."""
    for t, values in pairs:
        begin = np.searchsorted(t, window.begin)
        if begin < len(t) and t[begin] <= window.end:
            end = max(np.searchsorted(t, t[begin] + duration, "right"), begin + FEWEST_SAMPLES)
            end = min(end, np.searchsorted(t, window.end, "right"))
            return t[begin:end], values[begin:end]
    return None


class _Beginning(NamedTuple):
    """The first attitudes of a window, from which follows the state at its start."""

    since: np.ndarray  # (samples,), recorded s since the first attitude
    R: np.ndarray  # (samples, 3, 3)
    start: float  # of the window, recorded s since the first attitude
    omega: np.ndarray | None  # (3,), rad/s, where rates tell


def _beginning(measured: Measured, window: Window, duration: float) -> _Beginning:
    start = measured.t[np.searchsorted(measured.t, window.begin)]
    omega = None
    if (rates := _first_in(measured.rates, window, duration)) is not None:
        omega = _polynomial(rates[0] - start, rates[1])[0]
    attitudes = _first_in(measured.attitudes, window, duration)
    if attitudes is None:  # the attitudes after the window, if there are any
        later = Window(window.trajectory, window.begin, np.inf)
        attitudes = _first_in(measured.attitudes, later, duration)
    if attitudes is None:
        return _Beginning(np.zeros(1), np.eye(3)[None], 0.0, omega)
    t, R = attitudes
    near = _within_half_a_turn(t, R)  # beyond, rotation vectors jump
    # A copy, as a part would keep the attitudes of the whole trajectory in memory.
    return _Beginning(t[:near] - t[0], R[:near].copy(), start - t[0], omega)


def _states(beginnings: Sequence[_Beginning], time_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes (windows, 3, 3) and rates (windows, 3), rad/s, at the starts of windows."""
    counts = np.array([len(beginning.since) for beginning in beginnings])
    window, ends = np.repeat(np.arange(len(counts)), counts), np.cumsum(counts)
    R = np.concatenate([beginning.R for beginning in beginnings])
    origin, fits = np.stack([_central(beginning.R) for beginning in beginnings]), []
    for _ in range(2):  # about the first: there the derivative of a rotation vector is a rate
        turns = Rotation.from_matrix(np.swapaxes(origin, 1, 2)[window] @ R).as_rotvec()
        fits = [
            _polynomial(beginning.since, of_window)
            for beginning, of_window in zip(beginnings, np.split(turns, ends[:-1]), strict=True)
        ]
        origin = _turned(origin, np.stack([fit[0] for fit in fits]))
    omega, back = np.zeros((2, len(fits), 3))
    for i, (beginning, (_, *slopes)) in enumerate(zip(beginnings, fits, strict=True)):
        if beginning.omega is not None:
            omega[i] = beginning.omega
        elif slopes:
            omega[i] = slopes[0] / time_scale
        for power, slope in enumerate(slopes, 1):  # rates may begin before
            back[i] += beginning.start**power * slope
    return _turned(origin, back), omega


def _turned(R: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Attitudes (n, 3, 3) after turns by rotation vectors (n, 3), orthogonal to rounding."""
    return (Rotation.from_matrix(R) * Rotation.from_rotvec(turns)).as_matrix()


def _within_half_a_turn(t: np.ndarray, R: np.ndarray) -> int:
    """Number of first attitudes within half a turn; single wrong attitudes do not matter."""
    if len(R) < 3:
        return len(R)
    interval, turn = np.diff(t), angles_between(R[:-1], R[1:])
    usual = np.median(turn / interval) * interval
    turned = np.cumsum(np.minimum(turn, LEAP * usual) if usual.any() else turn)
    return 1 + max(1, int(np.searchsorted(turned, HALF_TURN)))


def _central(R: np.ndarray) -> np.ndarray:
    """An attitude (3, 3) near most others, and so not a single wrong attitude."""
    index = np.linspace(0, len(R) - 1, min(len(R), MOST_COMPARED)).astype(int)
    some = R[index].reshape(-1, 9)
    # The trace of a turn is 4 cos^2 - 1 of half its angle.
    cosines = np.sqrt(np.maximum(some @ some.T + 1, 0))
    return R[index[np.argmax(np.sum(cosines, axis=1))]]


def _polynomial(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients (degree+1, 3) of a fit, the constant first: cubic if there is enough data.

    A single value that causes most of the sum of squared residuals is not fitted.
    """
    degree = min(3, max(len(t) // 2 - 1, min(len(t) - 1, 1)))
    scale = max(t[-1] - t[0], 1e-300)
    powers = np.vander(t / scale, degree + 1, increasing=True)
    for _ in range(1 + len(t) // FEWEST_SAMPLES):
        orthogonal = np.linalg.qr(powers)[0]
        left = values - orthogonal @ (orthogonal.T @ values)
        squares = np.sum(left**2, axis=1)
        # The decrease of the sum without each value.
        part = squares / np.maximum(1 - np.sum(orthogonal**2, axis=1), 1e-9)
        freedom = len(values) - degree - 1
        if freedom < 2 or np.max(part) <= min(0.5, SPOILT / freedom) * np.sum(squares):
            break
        kept = np.arange(len(values)) != np.argmax(part)
        powers, values = powers[kept], values[kept]
    coefficients = np.linalg.lstsq(powers, values, rcond=None)[0]
    return coefficients / scale ** np.arange(degree + 1)[:, None]
