"""Initial states computed from what was recorded, so that no guess of them is needed."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy.spatial.transform import Rotation

from ...modules.sensors.base import require_fields
from ..arguments import require_sensors
from ..data.recordings import Recordings
from ..data.samples import OfTrajectory, reading_times
from ..model.free import ravel, unravel
from ..model.model import Model
from ..model.states import InitialStates, state_leaves
from .grid import Window, whole_trajectories
from .schedule import FEWEST_SAMPLES, SHORTEST_TURN
from .trials import Trials
from .vectors import Vectors, attitude_about, find_attitudes

SMALL_TURN = 0.7  # rad, over which a rate is a difference of two attitudes
SPOILT = 20  # a square so many times the usual one is not fitted
HALF_TURN = 2.8  # rad, pi less a margin for noise
LEAP = 3  # a turn between readings counts at most so many times the usual one
MOST_TURNS = 2000  # of a trajectory that are looked at for its speed
SOME = 32  # attitudes of a window that are compared to find a central one


class Measured(NamedTuple):
    """Attitudes and rates that the readings of one trajectory give directly, by sensor."""

    t: np.ndarray  # of all readings
    attitudes: list[tuple[np.ndarray, np.ndarray]]  # (t, R)
    rates: list[tuple[np.ndarray, np.ndarray]]  # (t, omega)
    vectors: list[tuple[np.ndarray, np.ndarray]]  # (t, unit vector in the body and in space)
    others: list[tuple[np.ndarray, np.ndarray]]  # (t, readings) that depend on an attitude


def measure_states(model: Model, trajectory: OfTrajectory) -> Measured:
    """Attitudes and angular velocities of a trajectory, as the sensors guess them."""
    times = reading_times([trajectory[each] for each in model.sensors])
    measured, time_scale = Measured(times, [], [], [], []), float(model.time_scale)
    several = []
    for channel, sensor in model.sensors.items():
        t, values = trajectory[channel]
        if not len(t):
            continue
        R, omega = sensor.guess_state(values)
        depends = sensor.depends_on_attitude and R is None
        for given, found in (
            (R, measured.attitudes),
            (omega, measured.rates),
            (values if depends else None, measured.others),
        ):
            if given is not None:
                found.append((t, given))
        pairs = sensor.guess_vectors(t * time_scale, values)
        if pairs is not None and len((vectors := Vectors.of(t, *pairs)).t):
            several.append(vectors)
    several.sort(key=lambda vectors: -len(vectors.t))
    measured.vectors.extend((each.t, np.hstack(each[1:])) for each in several)
    if not measured.attitudes and (attitudes := find_attitudes(several)) is not None:
        measured.attitudes.append(attitudes)
    return measured


def initial_rates(model: Model, states: InitialStates) -> np.ndarray:
    """The turn in a recorded second of states (trajectories,), rad."""
    return np.linalg.norm(np.asarray(states.omega, float), axis=1) * float(model.time_scale)


def largest_rates(
    model: Model, recordings: Recordings, states: InitialStates | None = None
) -> np.ndarray:
    """About the largest turn of each trajectory in a recorded second (trajectories,), rad.

    Where no sensor tells a rate, it is that of the initial `states`, or zero without them; and that
    of a vector at least.
    """
    time_scale = float(model.time_scale)
    speeds, least = np.zeros(len(recordings)), np.zeros(len(recordings))
    for i, samples in enumerate(recordings):
        measured = measure_states(model, samples)
        speeds[i] = max(_speeds(measured, time_scale), default=0.0)
        if not speeds[i] > 0:
            least[i] = _speed_across(measured)
    if states is not None:
        least = np.maximum(least, initial_rates(model, states))
    return np.where(speeds > 0, speeds, least)


def _speeds(measured: Measured, time_scale: float) -> Iterator[float]:
    """The speed by each sensor; single wrong readings do not matter."""
    for _, rates in measured.rates:
        yield np.quantile(np.linalg.norm(rates, axis=1), 0.95) * time_scale
    for t, R in measured.attitudes:
        if len(t) < 2:
            continue
        # The longest lag over which the body does not turn far: the least noise.
        lag = 1
        while True:
            first = np.arange(0, len(t) - lag, max(1, len(t) // MOST_TURNS))
            begin, end = (Rotation.from_matrix(R[i]) for i in (first, first + lag))
            turn = (begin.inv() * end).magnitude()
            speed = turn / (t[first + lag] - t[first])
            if 2 * lag >= len(t) or np.quantile(turn, 0.9) > SMALL_TURN:
                break
            lag *= 2
        yield np.quantile(speed, 0.95)


def _speed_across(measured: Measured) -> float:
    """The largest speed across a vector: the body turns about the vector too."""
    speeds = (Vectors(t, *np.split(values, 2, axis=1)).speed() for t, values in measured.vectors)
    return max(speeds, default=0.0)


def initial_states(model: Model, recordings: Recordings) -> InitialStates:
    """Initial states of all trajectories, computed from their first samples.

    The angular velocity is that of a gyroscope if there is one, else the derivative of a polynomial
    through attitudes. Good to some per cent, if the body turns much less than half a turn between
    two samples. Two directions give attitudes; one gives the attitude but for a turn about it, and
    the rate across it. What no sensor tells is the identity, or zero. Where a sensor has a state of
    its own, such as a position, it is in `own`.

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

    And what of these is not known, and is to be tried. `speeds` (trajectories,) are the largest
    rates.
    """
    time_scale, durations = float(model.time_scale), SHORTEST_TURN / np.maximum(speeds, 1e-300)
    found, trials = [], []
    for measured, window in _with_measured(model, recordings, windows):
        given = window, durations[window.trajectory], time_scale
        about = _about_vector(measured, *given)
        found.append(_state(measured, *given) if about is None else about[:2])
        unknown = about is None and _is_unknown(measured, window)
        axis, turning, moves = (np.zeros(3), np.zeros(3), False) if about is None else about[2:]
        # Where a vector of space does not move, all turns about it look alike.
        others = sum(_first_in([each], window, 0.0) is not None for each in measured.others)
        turns = moves or others > 1 or model.torque is not None
        rate = _first_in(measured.rates, window, 0.0) is None
        speed = speeds[window.trajectory] / time_scale
        trials.append((unknown, axis, turning, turns, rate, speed))
    dtype = jax.dtypes.canonicalize_dtype(float)
    R, omega = (np.stack(column).astype(dtype) for column in zip(*found, strict=True))
    own = _guess_fields(model, recordings, windows)
    states = InitialStates(R, omega, None if own is None else own.astype(dtype))
    return states, Trials(*(np.stack(column) for column in zip(*trials, strict=True)))


def _guess_fields(
    model: Model, recordings: Recordings, windows: Sequence[Window]
) -> np.ndarray | None:
    """The states of sensors at the first reading of each window (windows, m); None without any."""
    states = state_leaves(model)
    if states is None:
        return None
    leaves = eqx.filter(model, states)
    guessed = np.tile(ravel(leaves), (len(windows), 1))
    place = unravel(jax.tree.map(np.asarray, leaves), np.arange(guessed.shape[1], dtype=float))
    for trajectory, some in groupby(range(len(windows)), lambda i: windows[i].trajectory):
        samples = recordings.of(trajectory)
        t_all = reading_times([samples[each] for each in model.sensors])
        for i in some:
            start = t_all[np.searchsorted(t_all, windows[i].begin)]
            for channel, sensor in model.sensors.items():
                t, values = samples[channel]
                end = np.searchsorted(t, windows[i].end, "right")
                part = slice(np.searchsorted(t, windows[i].begin), end)
                if not sensor.state_fields or not len(t[part]):
                    continue
                since = (t[part] - start) * float(model.time_scale)
                found = sensor.guess_fields(since, values[part])
                require_fields(sensor, found)
                for field, value in found.items():
                    at = np.asarray(getattr(place.sensors[channel], field)).astype(int)
                    guessed[i, at.ravel()] = np.ravel(value)
    return guessed


def _is_unknown(measured: Measured, window: Window) -> bool:
    """Whether readings of a window depend on the attitude, and none gives it."""
    attitude, other = (
        _first_in(each, window, 0.0) for each in (measured.attitudes, measured.others)
    )
    return attitude is None and other is not None


def _about_vector(
    measured: Measured, window: Window, duration: float, time_scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, bool] | None:
    """Of a window in which one vector gives the attitude but for a turn about the vector.

    Attitude (3, 3) and rate (3,), rad/s, of one turn and without a rate about the vector, if
    nothing gives the rate; the unit vector (3,); the part of the rate (3,) that another turn
    turns about the vector, the other way; and whether the vector moves in space.
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
    of_body, of_space = (each / np.linalg.norm(each) for each in (first[:3], first[3:]))
    R = attitude_about(of_body, of_space)
    if (rates := _first_in(measured.rates, window, duration)) is not None:
        omega, turning = _polynomial(rates[0] - start, rates[1])[0], np.zeros(3)
    else:
        turning = np.cross(of_body, R.T @ change[3:])
        omega = turning - np.cross(of_body, change[:3])
    back = Rotation.from_rotvec(omega * ((start - t[0]) * time_scale))  # rates may begin before
    moves = bool(np.ptp(values[:, 3:], axis=0).any())
    return R @ back.as_matrix(), omega, back.inv().apply(of_body), turning, moves


def _with_measured(
    model: Model, recordings: Recordings, windows: Sequence[Window]
) -> Iterator[tuple[Measured, Window]]:
    """Each window with what its trajectory gives; those of a trajectory follow one another."""
    for trajectory, some in groupby(windows, lambda window: window.trajectory):
        measured = measure_states(model, recordings.of(trajectory))
        for window in some:
            yield measured, window


def _first_in(
    given: list[tuple[np.ndarray, np.ndarray]], window: Window, duration: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """The first readings in a window, of the first sensor that has some there."""
    for t, values in given:
        begin = np.searchsorted(t, window.begin)
        if begin < len(t) and t[begin] <= window.end:
            end = max(np.searchsorted(t, t[begin] + duration, "right"), begin + FEWEST_SAMPLES)
            end = min(end, np.searchsorted(t, window.end, "right"))
            return t[begin:end], values[begin:end]
    return None


def _state(
    measured: Measured, window: Window, duration: float, time_scale: float
) -> tuple[np.ndarray, np.ndarray]:
    start = measured.t[np.searchsorted(measured.t, window.begin)]
    omega = np.zeros(3)
    if (rates := _first_in(measured.rates, window, duration)) is not None:
        omega = _polynomial(rates[0] - start, rates[1])[0]
    attitudes = _first_in(measured.attitudes, window, duration)
    if attitudes is None:  # those that follow the window, if there are some
        later = Window(window.trajectory, window.begin, np.inf)
        attitudes = _first_in(measured.attitudes, later, duration)
    if attitudes is None:
        return np.eye(3), omega
    t, rotation = attitudes[0], Rotation.from_matrix(attitudes[1])
    near = _within_half_a_turn(t, rotation)  # farther on rotation vectors jump
    t, rotation = t[:near], rotation[:near]
    coefficients, origin = np.zeros((1, 3)), _central(rotation)
    for _ in range(2):  # about the first: there the derivative of a rotation vector is a rate
        coefficients = _polynomial(t - t[0], (origin.inv() * rotation).as_rotvec())
        origin = origin * Rotation.from_rotvec(coefficients[0])
        coefficients[0] = 0
    if rates is None and len(coefficients) > 1:
        omega = coefficients[1] / time_scale
    back = (start - t[0]) ** np.arange(len(coefficients)) @ coefficients  # rates may begin before
    return (origin * Rotation.from_rotvec(back)).as_matrix(), omega


def _within_half_a_turn(t: np.ndarray, rotation: Rotation) -> int:
    """Number of first attitudes within half a turn; single wrong attitudes do not matter."""
    if len(rotation) < 3:
        return len(rotation)
    interval, turn = np.diff(t), (rotation[:-1].inv() * rotation[1:]).magnitude()
    usual = np.median(turn / interval) * interval
    turned = np.cumsum(np.minimum(turn, LEAP * usual) if usual.any() else turn)
    return 1 + max(1, int(np.searchsorted(turned, HALF_TURN)))


def _central(rotation: Rotation) -> Rotation:
    """An attitude near most others, so that it is not a wrong one."""
    some = np.linspace(0, len(rotation) - 1, min(len(rotation), SOME)).astype(int)
    q = rotation.as_quat()[some]
    return Rotation.from_quat(q[np.argmax(np.sum(abs(q @ q.T), axis=1))])


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
        # Decrease of the sum if a value is left out.
        part = squares / np.maximum(1 - np.sum(orthogonal**2, axis=1), 1e-9)
        freedom = len(values) - degree - 1
        if freedom < 2 or np.max(part) <= min(0.5, SPOILT / freedom) * np.sum(squares):
            break
        kept = np.arange(len(values)) != np.argmax(part)
        powers, values = powers[kept], values[kept]
    coefficients = np.linalg.lstsq(powers, values, rcond=None)[0]
    return coefficients / scale ** np.arange(degree + 1)[:, None]
