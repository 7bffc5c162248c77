"""Attitudes, rates and speeds of the body that follow from readings directly."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ..data.recordings import Recordings
from ..data.samples import OfTrajectory, reading_times
from ..model.model import Model
from ..model.states import InitialStates
from ..segments.levels import mean_intervals

PARALLEL = 1e-3  # largest singular value of unit vectors that count as parallel
NEAR = 0.7  # rad, largest turn of the body between readings that are joined
LONGEST_TURN = 0.7  # rad, over which the speed of a vector is a difference of two readings
ABOVE_NOISE = 1.2  # times the turn between neighbours, above which a turn is not noise
MOST_TURNS = 2000  # of a trajectory that are used for the speed

SMALL_TURN = 0.7  # rad, over which a rate is a difference of two attitudes
# rad between samples, where no step is given: a hundred steps.
LONGEST_INTERVAL = 20.0


def _quantile(values: np.ndarray, part: float) -> float:
    """The value below which a part of the values are; NumPy's, which interpolates, takes longer."""
    return float(np.sort(values)[round(part * (len(values) - 1))])


class Vectors(NamedTuple):
    """Unit vectors at the times of readings (samples,), in both frames (samples, 3)."""

    t: np.ndarray
    in_body: np.ndarray
    in_space: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, in_body: np.ndarray, in_space: np.ndarray) -> "Vectors":
        """Vectors of any length; vectors without a direction are left out."""
        lengths = [np.linalg.norm(vectors, axis=1) for vectors in (in_body, in_space)]
        kept = (lengths[0] > 0) & (lengths[1] > 0)
        in_body, in_space = (
            vectors[kept] / length[kept, None]
            for vectors, length in zip((in_body, in_space), lengths, strict=True)
        )
        return cls(t[kept], in_body, in_space)

    def at(self, t: np.ndarray) -> "Vectors":
        """The vectors at other times, linear between readings."""

        def between(vectors: np.ndarray) -> np.ndarray:
            values = np.stack([np.interp(t, self.t, column) for column in vectors.T], axis=1)
            return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-300)

        return Vectors(t, between(self.in_body), between(self.in_space))

    def gaps(self, t: np.ndarray) -> np.ndarray:
        """The interval between the readings around each time; infinite outside of the readings."""
        after = np.searchsorted(self.t, t, "right")
        inner = (after > 0) & (t <= self.t[-1])
        after = np.clip(after, 1, len(self.t) - 1)
        return np.where(inner, self.t[after] - self.t[after - 1], np.inf)

    def speed(self) -> float:
        """About the largest rate across the vector, rad/s; single wrong readings do not matter.

        The largest over lags of a turn less the turn between neighbours, which may be mostly
        noise: a vector near the axis of rotation turns on a small circle, and by no large angle.
        """
        speeds = [0.0]
        for vectors in (self.in_body, self.in_space) if len(self.t) > 1 else ():
            lag, noise = 1, 0.0
            while True:
                first = np.arange(0, len(self.t) - lag, max(1, len(self.t) // MOST_TURNS))
                chord = np.linalg.norm(vectors[first + lag] - vectors[first], axis=1)
                turn = _quantile(2 * np.arcsin(np.clip(chord / 2, 0, 1)), 0.95)
                duration = np.median(self.t[first + lag] - self.t[first])
                if lag == 1:
                    noise = turn
                    if turn > LONGEST_TURN or len(self.t) < 4:
                        speeds.append(turn / duration)
                elif turn > ABOVE_NOISE * noise:
                    speeds.append(np.sqrt(turn**2 - noise**2) / duration)
                if 2 * lag >= len(self.t) or turn > LONGEST_TURN:
                    break
                lag *= 2
        return float(max(speeds))


def find_attitudes(all_vectors: list[Vectors]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and attitudes (samples, 3, 3) at which vectors are not parallel; None without any.

    At the times of the vector with the fewest readings, where other readings are near. Also None
    if the body turns far from one time to the next. F. L. Markley, "Attitude determination
    using vector observations and the singular value decomposition", J. Astronaut. Sci. 36 (1988).
    """
    if len(all_vectors) < 2:
        return None
    speed = max(vectors.speed() for vectors in all_vectors)
    t = min(all_vectors, key=lambda vectors: len(vectors.t)).t
    for vectors in all_vectors:
        t = t[vectors.gaps(t) <= NEAR / max(speed, 1e-300)]
    if not len(t) or (len(t) > 1 and np.median(np.diff(t)) * speed > NEAR):
        return None
    pairs = [vectors.at(t) for vectors in all_vectors]
    profile = sum(np.einsum("ni,nj->nij", pair.in_space, pair.in_body) for pair in pairs)
    u, singular, v = np.linalg.svd(profile)
    seen = singular[:, 1] > PARALLEL
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    return (t[seen], (u @ v)[seen]) if seen.any() else None


def attitude_about(in_body: np.ndarray, in_space: np.ndarray) -> np.ndarray:
    """An attitude (3, 3) that takes one unit vector to the other."""

    def frame(v: np.ndarray) -> np.ndarray:
        across = np.cross(v, np.eye(3)[np.argmin(np.abs(v))])
        across /= np.linalg.norm(across)
        return np.stack([v, across, np.cross(v, across)], axis=1)

    return frame(in_space) @ frame(in_body).T


def angles_between(R1: np.ndarray, R2: np.ndarray) -> np.ndarray:
    """Angles (n,), rad, from attitudes (n, 3, 3) to others."""
    # The norm of a difference is 2 sqrt(2) times the sine of half the turn.
    change = (R2 - R1).reshape(-1, 9)
    return 2 * np.arcsin(np.minimum(np.sqrt(np.sum(change * change, axis=1) / 8), 1))


class Measured(NamedTuple):
    """Attitudes and rates that the readings of one trajectory give directly, by sensor."""

    t: np.ndarray  # of all readings
    attitudes: list[tuple[np.ndarray, np.ndarray]]  # (t, R)
    rates: list[tuple[np.ndarray, np.ndarray]]  # (t, omega)
    vectors: list[tuple[np.ndarray, np.ndarray]]  # (t, unit vector in the body and in space)
    others: list[tuple[np.ndarray, np.ndarray]]  # (t, readings) that depend on an attitude


def measurer_of(model: Model) -> Callable[[OfTrajectory], Measured]:
    """A function that gives what the sensors of a model guess of a trajectory."""
    time_scale = float(model.time_scale)
    # To bind a method of a module takes longer than what the method does.
    sensors = [
        (channel, sensor.guess_state, sensor.guess_vectors, sensor.depends_on_attitude)
        for channel, sensor in model.sensors.items()
    ]

    def measure(trajectory: OfTrajectory) -> Measured:
        times = reading_times([trajectory[channel] for channel, *_ in sensors])
        measured, all_vectors = Measured(times, [], [], [], []), []
        for channel, guess_state, guess_vectors, depends_on_attitude in sensors:
            t, values = trajectory[channel]
            if not len(t):
                continue
            R, omega = guess_state(values)
            depends = depends_on_attitude and R is None
            for state, pairs in (
                (R, measured.attitudes),
                (omega, measured.rates),
                (values if depends else None, measured.others),
            ):
                if state is not None:
                    pairs.append((t, state))
            frames = guess_vectors(t * time_scale, values)
            if frames is not None and len((vectors := Vectors.of(t, *frames)).t):
                all_vectors.append(vectors)
        all_vectors.sort(key=lambda vectors: -len(vectors.t))
        measured.vectors.extend((vectors.t, np.hstack(vectors[1:])) for vectors in all_vectors)
        if not measured.attitudes and (attitudes := find_attitudes(all_vectors)) is not None:
            measured.attitudes.append(attitudes)
        return measured

    return measure


def initial_rates(model: Model, states: InitialStates) -> np.ndarray:
    """The turn in a recorded second of states (trajectories,), rad."""
    return np.linalg.norm(np.asarray(states.omega, float), axis=1) * float(model.time_scale)


def largest_rates(
    model: Model, recordings: Recordings, states: InitialStates | None = None
) -> np.ndarray:
    """About the largest turn of each trajectory in a recorded second (trajectories,), rad.

    Where no sensor tells a rate, the turn is that of the initial `states`, or zero without states,
    and at least that of a vector.
    """
    time_scale, measure = float(model.time_scale), measurer_of(model)
    speeds, least = np.zeros((2, len(recordings)))
    for i, samples in enumerate(recordings):
        measured = measure(samples)
        speeds[i] = max(_speeds(measured, time_scale), default=0.0)
        if not speeds[i] > 0:
            least[i] = _speed_across(measured)
    if states is not None:
        least = np.maximum(least, initial_rates(model, states))
    return np.where(speeds > 0, speeds, least)


def require_turns(recordings: Recordings, speeds: np.ndarray) -> None:
    """Check that no trajectory turns so far between samples that a fit would hardly end.

    Speeds (trajectories,) are in rad for each recorded second.

    Raises
    ------
    ValueError
        If a trajectory does.
    """
    turns = speeds * mean_intervals(recordings)
    if (turns > LONGEST_INTERVAL).any():
        i = int(np.argmax(turns > LONGEST_INTERVAL))
        raise ValueError(
            f"Trajectory {recordings.names[i]!r} must turn by at most {LONGEST_INTERVAL:g} rad "
            f"from sample to sample, but by its rates and times it turns by {turns[i]:.3g}: rates "
            "are in rad/s and times in s. If it does turn so far, give an `integrator` with its "
            "`dt`."
        )


def _speeds(measured: Measured, time_scale: float) -> Iterator[float]:
    """The speed by each sensor; single wrong readings do not matter."""
    for _, rates in measured.rates:
        yield _quantile(np.linalg.norm(rates, axis=1), 0.95) * time_scale
    for t, R in measured.attitudes:
        if len(t) < 2:
            continue
        # The longest lag over which the body does not turn far: the least noise.
        lag = 1
        while True:
            first = np.arange(0, len(t) - lag, max(1, len(t) // MOST_TURNS))
            turn = angles_between(R[first], R[first + lag])
            speed = turn / (t[first + lag] - t[first])
            if 2 * lag >= len(t) or _quantile(turn, 0.9) > SMALL_TURN:
                break
            lag *= 2
        yield _quantile(speed, 0.95)


def _speed_across(measured: Measured) -> float:
    """The largest speed across a vector: the body turns about the vector too."""
    speeds = (Vectors(t, *np.split(values, 2, axis=1)).speed() for t, values in measured.vectors)
    return max(speeds, default=0.0)
