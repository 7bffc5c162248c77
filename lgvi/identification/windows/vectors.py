r"""Attitudes and rates from vectors of which one sensor sees each, in the body frame or in space.

With $s = Rb$ for a vector $b$ in the body frame and $s$ in space, two vectors that are not parallel
give the attitude. One gives the attitude but for a turn about the vector, and the derivative,
$R^T\dot s = \dot b + \omega\times b$, gives the rate but for its part along the vector.
"""

from typing import NamedTuple

import numpy as np

PARALLEL = 1e-3  # singular value of unit vectors up to which they count as parallel
NEAR = 0.7  # rad, by which the body turns at most between readings that are joined
LONGEST_TURN = 0.7  # rad, over which the speed of a vector is a difference of two readings
ABOVE_NOISE = 1.2  # times the turn between neighbours, from which a turn is no noise
MOST_TURNS = 2000  # of a trajectory that are looked at for its speed


class Vectors(NamedTuple):
    """Unit vectors at the times of readings (samples,), in both frames (samples, 3)."""

    t: np.ndarray
    of_body: np.ndarray
    of_space: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, of_body: np.ndarray, of_space: np.ndarray) -> "Vectors":
        """Vectors of any length; those without a direction are left out."""
        lengths = [np.linalg.norm(each, axis=1) for each in (of_body, of_space)]
        kept = (lengths[0] > 0) & (lengths[1] > 0)
        of_body, of_space = (
            each[kept] / length[kept, None]
            for each, length in zip((of_body, of_space), lengths, strict=True)
        )
        return cls(t[kept], of_body, of_space)

    def at(self, t: np.ndarray) -> "Vectors":
        """Linear between readings."""

        def between(vectors: np.ndarray) -> np.ndarray:
            found = np.stack([np.interp(t, self.t, column) for column in vectors.T], axis=1)
            return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-300)

        return Vectors(t, between(self.of_body), between(self.of_space))

    def gaps(self, t: np.ndarray) -> np.ndarray:
        """The time between the readings about each time; infinite before the first and after."""
        after = np.searchsorted(self.t, t, "right")
        inner = (after > 0) & (t <= self.t[-1])
        after = np.clip(after, 1, len(self.t) - 1)
        return np.where(inner, self.t[after] - self.t[after - 1], np.inf)

    def speed(self) -> float:
        """About the largest rate across the vector, rad/s; single wrong readings do not matter.

        The largest over lags of a turn less the turn between neighbours, most of which may be
        noise: a vector near the axis of rotation turns on a small circle, and by no large angle.
        """
        found = [0.0]
        for each in (self.of_body, self.of_space) if len(self.t) > 1 else ():
            lag, noise = 1, 0.0
            while True:
                first = np.arange(0, len(self.t) - lag, max(1, len(self.t) // MOST_TURNS))
                chord = np.linalg.norm(each[first + lag] - each[first], axis=1)
                turn = np.quantile(2 * np.arcsin(np.clip(chord / 2, 0, 1)), 0.95)
                duration = np.median(self.t[first + lag] - self.t[first])
                if lag == 1:
                    noise = turn
                    if turn > LONGEST_TURN or len(self.t) < 4:
                        found.append(turn / duration)
                elif turn > ABOVE_NOISE * noise:
                    found.append(np.sqrt(turn**2 - noise**2) / duration)
                if 2 * lag >= len(self.t) or turn > LONGEST_TURN:
                    break
                lag *= 2
        return float(max(found))


def find_attitudes(several: list[Vectors]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and attitudes (samples, 3, 3) at which vectors are not parallel; None without any.

    At the times of the vector with the fewest readings, where those of the others are near. None
    too, if the body turns far from one time to the next. F. L. Markley, "Attitude determination
    using vector observations and the singular value decomposition", J. Astronaut. Sci. 36 (1988).
    """
    if len(several) < 2:
        return None
    speed = max(each.speed() for each in several)
    t = min(several, key=lambda each: len(each.t)).t
    for each in several:
        t = t[each.gaps(t) <= NEAR / max(speed, 1e-300)]
    if not len(t) or (len(t) > 1 and np.median(np.diff(t)) * speed > NEAR):
        return None
    pairs = [each.at(t) for each in several]
    profile = sum(np.einsum("ni,nj->nij", each.of_space, each.of_body) for each in pairs)
    u, singular, v = np.linalg.svd(profile)
    seen = singular[:, 1] > PARALLEL
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    return (t[seen], (u @ v)[seen]) if seen.any() else None


def attitude_about(of_body: np.ndarray, of_space: np.ndarray) -> np.ndarray:
    """An attitude (3, 3) that takes one unit vector to the other."""

    def frame(v: np.ndarray) -> np.ndarray:
        across = np.cross(v, np.eye(3)[np.argmin(np.abs(v))])
        across /= np.linalg.norm(across)
        return np.stack([v, across, np.cross(v, across)], axis=1)

    return frame(of_space) @ frame(of_body).T
