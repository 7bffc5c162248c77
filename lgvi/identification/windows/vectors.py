r"""Attitudes and rates from vectors of which one sensor sees each, in the body frame or in space.

With $s = Rb$ for a vector $b$ in the body frame and $s$ in space, two vectors that are not parallel
give the attitude. One gives the attitude but for a turn about the vector, and the derivative,
$R^T\dot s = \dot b + \omega\times b$, gives the rate but for its part along the vector.
"""

from typing import NamedTuple

import numpy as np

PARALLEL = 1e-3  # singular value of unit vectors up to which they count as parallel
LONGEST_TURN = 0.7  # rad, over which the speed of a vector is a difference of two readings
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
        columns = (
            np.stack([np.interp(t, self.t, column) for column in each.T], axis=1)
            for each in (self.of_body, self.of_space)
        )
        return Vectors.of(t, *columns)

    def speed(self) -> float:
        """About the largest rate across the vector, rad/s; single wrong readings do not matter."""
        found = [0.0]
        for each in (self.of_body, self.of_space) if len(self.t) > 1 else ():
            lag = 1
            while True:  # the longest over which the vector does not turn far: the least noise
                first = np.arange(0, len(self.t) - lag, max(1, len(self.t) // MOST_TURNS))
                begin, end = each[first], each[first + lag]
                turn = 2 * np.arcsin(np.clip(np.linalg.norm(end - begin, axis=1) / 2, 0, 1))
                speed = turn / (self.t[first + lag] - self.t[first])
                if 2 * lag >= len(self.t) or np.quantile(turn, 0.9) > LONGEST_TURN:
                    break
                lag *= 2
            found.append(float(np.quantile(speed, 0.95)))
        return max(found)


def find_attitudes(several: list[Vectors]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and attitudes (samples, 3, 3) at which vectors are not parallel; None without any.

    At the times of the first vector. F. L. Markley, "Attitude determination using vector
    observations and the singular value decomposition", J. Astronaut. Sci. 36 (1988).
    """
    if len(several) < 2:
        return None
    begin, end = max(each.t[0] for each in several), min(each.t[-1] for each in several)
    t = several[0].t
    t = t[(begin <= t) & (t <= end)]
    found = [each.at(t) for each in several]
    if not len(t) or any(len(each.t) < len(t) for each in found):
        return None
    profile = sum(np.einsum("ni,nj->nij", each.of_space, each.of_body) for each in found)
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
