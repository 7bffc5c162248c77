"""Initial states computed from what was recorded, so that no guess of them is needed."""

from collections.abc import Iterator, Sequence

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from ..arguments import require_instance
from ..data.recordings import Recordings
from ..data.samples import SENSED, OfTrajectory
from ..model.states import InitialStates
from .grid import FEWEST, TURN, Window, whole

SMALL_TURN = 0.7  # rad, over which a rate is a difference of two attitudes
SPOILT = 20  # times the usual square
HALF_TURN = 2.8  # rad, less than pi by some noise
LEAP = 3  # times the usual turn from reading to reading
SOME = 32  # attitudes of a window, to find one that is not wrong


def largest_rates(recordings: Recordings, time_scale: float = 1.0) -> np.ndarray:
    """About the largest turn of each trajectory in a recorded second (trajectories,), rad."""
    return np.array([max(_speeds(samples, time_scale), default=0.0) for samples in recordings])


def _speeds(samples: OfTrajectory, time_scale: float) -> Iterator[float]:
    """By each sensor; single readings that are wrong do not matter."""
    if (rates := samples["angular_velocity"]) is not None and len(rates[0]):
        yield np.quantile(np.linalg.norm(rates[1], axis=1), 0.95) * time_scale
    if (attitudes := samples["attitude"]) is not None and len(attitudes[0]) > 1:
        t, R = attitudes
        rotation = Rotation.from_matrix(R)
        # The longest lag over which the body does not turn far: the least noise.
        lag = 1
        while True:
            turn = (rotation[:-lag].inv() * rotation[lag:]).magnitude()
            speed = turn / (t[lag:] - t[:-lag])
            if 2 * lag >= len(t) or np.quantile(turn, 0.9) > SMALL_TURN:
                break
            lag *= 2
        yield np.quantile(speed, 0.95)


def initial_states(recordings: Recordings) -> InitialStates:
    """Initial states of all trajectories, computed from their first samples.

    The angular velocity is that of a gyroscope if there is one, else the derivative of a polynomial
    through attitudes. Good to some per cent, if the body turns much less than half a turn between
    two samples.
    """
    require_instance("recordings", recordings, Recordings)
    return jax.device_put(states_of(recordings, whole(recordings), largest_rates(recordings)))


def states_of(
    recordings: Recordings,
    windows: Sequence[Window],
    speeds: np.ndarray,
    time_scale: float = 1.0,
) -> InitialStates:
    """States at the first sample of each window, from the samples within `TURN`.

    `speeds` (trajectories,) are the largest rates.
    """
    trajectories = list(recordings)
    durations = TURN / np.maximum(speeds, 1e-300)
    found = [
        _state(trajectories[window.trajectory], window, durations[window.trajectory], time_scale)
        for window in windows
    ]
    dtype = jax.dtypes.canonicalize_dtype(float)
    R, omega = (np.stack(column).astype(dtype) for column in zip(*found, strict=True))
    return InitialStates(R, omega)


def _state(
    samples: OfTrajectory, window: Window, duration: float, time_scale: float
) -> tuple[np.ndarray, np.ndarray]:
    cut = {}
    for kind in SENSED:
        if (of_kind := samples[kind]) is not None:
            t, value = of_kind
            begin, end = np.searchsorted(t, [window.begin, window.end])
            if begin < len(t) and t[begin] <= window.end:
                end = max(np.searchsorted(t, t[begin] + duration, "right"), begin + FEWEST)
                end = min(end, np.searchsorted(t, window.end, "right"))
                cut[kind] = t[begin:end], value[begin:end]
    start = min(t[0] for t, _ in cut.values())
    omega = np.zeros(3)
    if "angular_velocity" in cut:
        t, rates = cut["angular_velocity"]
        omega = _polynomial(t - start, rates)[0]
    if "attitude" not in cut:
        return np.eye(3), omega
    t, R = cut["attitude"]
    rotation = Rotation.from_matrix(R)
    near = _within_half_a_turn(t, rotation)  # farther on rotation vectors jump
    t, rotation = t[:near], rotation[:near]
    coefficients, origin = np.zeros((1, 3)), _central(rotation)
    for _ in range(2):  # about the first: there the derivative of a rotation vector is a rate
        coefficients = _polynomial(t - t[0], (origin.inv() * rotation).as_rotvec())
        origin = origin * Rotation.from_rotvec(coefficients[0])
        coefficients[0] = 0
    if "angular_velocity" not in cut and len(coefficients) > 1:
        omega = coefficients[1] / time_scale
    back = (start - t[0]) ** np.arange(len(coefficients)) @ coefficients  # rates may begin before
    return (origin * Rotation.from_rotvec(back)).as_matrix(), omega


def _within_half_a_turn(t: np.ndarray, rotation: Rotation) -> int:
    """How many of the first attitudes are; single ones that are wrong do not matter."""
    if len(rotation) < 3:
        return len(rotation)
    interval, turn = np.diff(t), (rotation[:-1].inv() * rotation[1:]).magnitude()
    usual = np.median(turn / interval) * interval
    turned = np.cumsum(np.minimum(turn, LEAP * usual) if usual.any() else turn)
    return 1 + max(1, int(np.searchsorted(turned, HALF_TURN)))


def _central(rotation: Rotation) -> Rotation:
    """One that is near to the others, as none is that is wrong."""
    some = np.linspace(0, len(rotation) - 1, min(len(rotation), SOME)).astype(int)
    q = rotation.as_quat()[some]
    return Rotation.from_quat(q[np.argmax(np.sum(abs(q @ q.T), axis=1))])


def _polynomial(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients (degree+1, 3) of a fit, the constant first: cubic if there is enough data.

    A single value that makes most of what is left of the squares is not fitted.
    """
    degree = min(3, max(len(t) // 2 - 1, min(len(t) - 1, 1)))
    scale = max(t[-1] - t[0], 1e-300)
    powers = np.vander(t / scale, degree + 1, increasing=True)
    for _ in range(1 + len(t) // FEWEST):
        orthogonal = np.linalg.qr(powers)[0]
        left = values - orthogonal @ (orthogonal.T @ values)
        squares = np.sum(left**2, axis=1)
        # What each takes of the sum when it is left out.
        part = squares / np.maximum(1 - np.sum(orthogonal**2, axis=1), 1e-9)
        freedom = len(values) - degree - 1
        if freedom < 2 or np.max(part) <= min(0.5, SPOILT / freedom) * np.sum(squares):
            break
        kept = np.arange(len(values)) != np.argmax(part)
        powers, values = powers[kept], values[kept]
    coefficients = np.linalg.lstsq(powers, values, rcond=None)[0]
    return coefficients / scale ** np.arange(degree + 1)[:, None]
