"""Samples and their checks: times that increase, finite numbers, rotations that are some."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

SENSED = ("attitude", "angular_velocity")
GIVEN = ("body_torque", "rotor_momentum")
KINDS = SENSED + GIVEN
TOLERANCE = 1e-3  # how far a quaternion or a matrix may be from a rotation

OfTrajectory = dict[str, tuple[np.ndarray, np.ndarray] | None]  # (t, value) by quantity


class Samples(eqx.Module):
    """Samples of one quantity in all trajectories, one after another.

    Attributes
    ----------
    times
        Times (samples,), s, increasing within a trajectory.
    values
        Values (samples, ...).
    count
        Number of samples of each trajectory (trajectories,).
    """

    times: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples *shape"]
    count: Int[np.ndarray, " trajectories"]

    @classmethod
    def stack(cls, samples: Sequence[tuple[np.ndarray, np.ndarray]]) -> "Samples":
        """Put `(t, value)` of each trajectory one after another."""
        given = [each for each in samples if len(each[0])] or [
            max(samples, key=lambda each: each[1].ndim)
        ]
        count = np.array([len(t) for t, _ in samples])
        times, values = (np.concatenate(column) for column in zip(*given, strict=True))
        for array in (times, values, count):
            array.setflags(write=False)
        return cls(times, values, count)

    def of(self, trajectory: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (samples,) and values (samples, ...) of a trajectory."""
        end = int(np.sum(self.count[: trajectory + 1]))
        part = slice(end - int(self.count[trajectory]), end)
        return self.times[part], self.values[part]

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Something of each sample (samples, ...), as an array for each trajectory."""
        return np.split(values, np.cumsum(self.count)[:-1])

    @property
    def mask(self) -> Bool[np.ndarray, "trajectories longest"]:
        """True where there is a sample in the padded arrays `t` and `value`."""
        return np.arange(self.count.max(initial=0)) < self.count[:, None]

    @property
    def t(self) -> Float[np.ndarray, "trajectories longest"]:
        """Times side by side, padded with the last one of each trajectory."""
        return self._padded(self.times)

    @property
    def value(self) -> Float[np.ndarray, "trajectories longest *shape"]:
        """Values side by side, padded with the last one of each trajectory."""
        return self._padded(self.values)

    def _padded(self, values: np.ndarray) -> np.ndarray:
        longest, first = self.count.max(initial=0), np.cumsum(self.count) - self.count
        kept = np.minimum(np.arange(longest), np.maximum(self.count - 1, 0)[:, None])
        result = values[np.minimum(first[:, None] + kept, len(values) - 1)]
        result[self.count == 0] = 0
        result.setflags(write=False)
        return result


class Problem(NamedTuple):
    """What is wrong with a sample."""

    sample: int
    component: int | None  # None is all of them, -1 the time
    words: str


def find_problem(kind: str, t: np.ndarray, value: np.ndarray) -> Problem | None:
    """The first sample that is none, of values (samples, components)."""
    if (bad := _first(~np.isfinite(t))) is not None:
        return Problem(bad, -1, f"must be finite, but is {t[bad]}")
    if (bad := _first(np.diff(t) <= 0)) is not None:
        words = f"must increase within a trajectory, but {t[bad + 1]:.12g} follows {t[bad]:.12g}"
        return Problem(bad + 1, -1, words)
    if (bad := _first(~np.isfinite(value).all(1))) is not None:
        component = int(np.argmin(np.isfinite(value[bad])))
        return Problem(bad, component, f"must be finite, but is {value[bad, component]}")
    if kind != "attitude":
        return None
    if value.shape[1] == 4:
        length = np.linalg.norm(value, axis=1)
        if (bad := _first(abs(length - 1) > TOLERANCE)) is not None:
            return Problem(bad, None, f"must have length 1, but has {length[bad]:.6g}")
        return None
    R = value.reshape(-1, 3, 3)
    defect = abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max((1, 2))
    bad = _first((defect > TOLERANCE) | (np.linalg.det(R) < 0))
    if bad is None:
        return None
    return Problem(bad, None, f"must be a rotation matrix, but is {R[bad].tolist()}")


def as_matrices(value: np.ndarray) -> np.ndarray:
    """Rotations (samples, 3, 3) of quaternions (samples, 4), scalar first, or of near rotations."""
    if value.shape[1] == 4:
        return Rotation.from_quat(value, scalar_first=True).as_matrix()
    left, _, right = np.linalg.svd(value.reshape(-1, 3, 3))
    return left @ right


def as_samples(kind: str, t: Any, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checked times (samples,) and values (samples, ...) of what the user gives for a quantity."""
    if isinstance(value, tuple) and len(value) == 2:
        t, value = value
    matrix: Any = getattr(value, "as_matrix", None)
    if t is None:
        raise ValueError(f"Argument `t` must be given, or `{kind}` be a tuple of times and values.")
    if matrix is not None:
        value = matrix()
    value, t = _floats(kind, value), _floats("t", t)
    if t.ndim != 1 or len(t) == 0:
        raise ValueError(
            "Argument `t` must have shape (samples,), of one trajectory with one sample at least, "
            f"but its shape is {t.shape}."
        )
    shapes: Sequence[tuple[int, ...]] = [(4,), (3, 3)] if kind == "attitude" else [(3,)]
    if value.shape[:1] != t.shape or value.shape[1:] not in shapes:
        wanted = " or ".join(str((len(t), *shape)) for shape in shapes)
        raise ValueError(
            f"Argument `{kind}` must have shape {wanted}, one entry for each time, but its shape "
            f"is {value.shape}."
        )
    flat = value.reshape(len(t), -1)
    if problem := find_problem(kind, t, flat):
        argument = "t" if problem.component == -1 else kind
        raise ValueError(f"Argument `{argument}` {problem.words}, in sample {problem.sample}.")
    return t, as_matrices(flat) if kind == "attitude" else flat


def _floats(name: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"its dtype is {array.dtype}")
    except (TypeError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise TypeError(
            f"Argument `{name}` must be an array of numbers, of one trajectory, but {reason}."
        ) from None
    return array.astype(float)


def _first(bad: Any) -> int | None:
    return int(np.argmax(bad)) if bad.any() else None


def require_complete(name: str, samples: OfTrajectory, given: Sequence[str]) -> None:
    """Check that a trajectory has enough samples, and that it is known what acted on it.

    Raises
    ------
    ValueError
        If not, naming the trajectory.
    """
    sensed = [each[0] for each in map(samples.get, SENSED) if each and len(each[0])]
    if len(sensed) == 0 or max(map(len, sensed)) < 2:
        raise ValueError(
            f"Trajectory {name!r} must have two samples of `attitude` or of `angular_velocity`, "
            "but has less."
        )
    first, last = min(t[0] for t in sensed), max(t[-1] for t in sensed)
    margin = 1e-9 * (last - first)
    for kind in given:
        of_kind = samples[kind]
        if of_kind is None or len(of_kind[0]) == 0:
            raise ValueError(
                f"Trajectory {name!r} must have `{kind}`, as others have, but has none."
            )
        t = of_kind[0]
        if t[0] > first + margin or t[-1] < last - margin:
            raise ValueError(
                f"`{kind}` of trajectory {name!r} must cover its measurements, from {first:.9g} to "
                f"{last:.9g} s, but goes from {t[0]:.9g} to {t[-1]:.9g} s."
            )
