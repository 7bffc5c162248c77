"""Recorded motion of a body: what was measured, when, and in which trajectory."""

from collections.abc import Iterable, Iterator, Sequence
from os import PathLike
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from .csv_file import read_table
from .samples import GIVEN, KINDS, SENSED, OfTrajectory, Samples, as_samples, require_complete


class Recordings(eqx.Module):
    """One or many recorded trajectories of a body, immutable.

    Make one with `from_arrays` or `from_csv`, and many with `from_csv` or `concatenate`. Each
    quantity is `None` or has times of its own; trajectories may differ in length and need not be
    sampled evenly.

    Attributes
    ----------
    attitude
        Attitudes (trajectories, samples, 3, 3), body to space.
    angular_velocity
        Angular velocities (trajectories, samples, 3), body frame, rad/s.
    body_torque
        Torques (trajectories, samples, 3), body frame, N m, linear between the samples.
    rotor_momentum
        Momenta of rotors relative to the body (trajectories, samples, 3), body frame, kg m²/s,
        linear between the samples. Speeds will do where their inertia is estimated.
    names
        A name for each trajectory.
    dropped
        What was dropped by request, in words.
    """

    attitude: Samples | None
    angular_velocity: Samples | None
    body_torque: Samples | None
    rotor_momentum: Samples | None
    names: tuple[str, ...] = eqx.field(static=True)
    dropped: tuple[str, ...] = eqx.field(default=(), static=True)

    @classmethod
    def from_arrays(
        cls,
        t: Any = None,
        *,
        attitude: Any = None,
        angular_velocity: Any = None,
        body_torque: Any = None,
        rotor_momentum: Any = None,
        name: str = "0",
    ) -> "Recordings":
        """One trajectory; `concatenate` puts several together.

        Parameters
        ----------
        t
            Times (samples,), s, increasing, of all quantities that do not bring their own.
        attitude
            Attitudes, body to space: unit quaternions (samples, 4), scalar first; matrices
            (samples, 3, 3); or an object with `as_matrix()`, such as
            `scipy.spatial.transform.Rotation` and `jaxlie.SO3`. For times of its own a tuple
            `(t, attitude)`, and so for all that follow. Quaternions and matrices may be off by
            1e-3, and are normalised.
        angular_velocity
            Angular velocities (samples, 3), body frame, rad/s.
        body_torque
            Torques (samples, 3), body frame, N m. They must cover the times of the above.
        rotor_momentum
            Momenta of rotors (samples, 3), body frame, kg m²/s. They must cover them too.
        name
            Name of the trajectory.

        Returns
        -------
        Recordings
            The trajectory.

        Raises
        ------
        ValueError, TypeError
            For input that is malformed, naming the argument and the sample.
        """
        given = (attitude, angular_velocity, body_torque, rotor_momentum)
        samples = {
            kind: None if value is None else as_samples(kind, t, value)
            for kind, value in zip(KINDS, given, strict=True)
        }
        return stacked([samples], (str(name),))

    @classmethod
    def from_csv(
        cls,
        file: str | PathLike[str],
        *,
        attitude: Sequence[str] | None = None,
        angular_velocity: Sequence[str] | None = None,
        body_torque: Sequence[str] | None = None,
        rotor_momentum: Sequence[str] | None = None,
        t: str = "t",
        trajectory: str | None = None,
    ) -> "Recordings":
        """All trajectories of a CSV file with a header, in UTF-8.

        Parameters
        ----------
        file
            The file. A line whose cells of a quantity are all empty has no sample of it.
        attitude
            Names of four columns of a unit quaternion, scalar first, or of nine of a matrix, row
            by row; body to space.
        angular_velocity, body_torque, rotor_momentum
            Names of three columns, units and frames as in `from_arrays`.
        t
            Name of the column of times, s, increasing within a trajectory.
        trajectory
            Name of the column that tells trajectories apart. By default it is `trajectory`, and a
            file without that column is one trajectory.

        Returns
        -------
        Recordings
            The trajectories, in the order of their first lines.

        Raises
        ------
        ValueError
            For anything that is malformed, naming the file, the line and the column.
        """
        given = (attitude, angular_velocity, body_torque, rotor_momentum)
        columns = {k: v for k, v in zip(KINDS, given, strict=True) if v is not None}
        if not columns.keys() & set(SENSED):
            raise ValueError(
                "Argument `attitude` or `angular_velocity` must name columns, but both are None."
            )
        table = read_table(file, columns, t, trajectory)
        try:
            return stacked(list(table.values()), tuple(table))
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error

    @classmethod
    def concatenate(cls, recordings: Iterable["Recordings"]) -> "Recordings":
        """The trajectories of several recordings together.

        Names that occur twice get the number of the recording in front.

        Raises
        ------
        ValueError
            If there is none.
        """
        recordings = list(recordings)
        for each in recordings:
            if not isinstance(each, cls):
                raise TypeError(
                    "Argument `recordings` must be several `Recordings`, but one is of the type "
                    f"`{type(each).__name__}`."
                )
        if not recordings:
            raise ValueError("Argument `recordings` must have at least one, but is empty.")
        names = [name for each in recordings for name in each.names]
        if len(set(names)) < len(names):
            names = [f"{i}:{name}" for i, each in enumerate(recordings) for name in each.names]
        dropped = tuple(words for each in recordings for words in each.dropped)
        return stacked([each for one in recordings for each in one], tuple(names), dropped)

    @property
    def sensed(self) -> tuple[Samples | None, Samples | None]:
        """Attitudes and angular velocities, in the order of a model's sensors."""
        return self.attitude, self.angular_velocity

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[OfTrajectory]:
        """For each trajectory a dictionary of `(t, value)` by quantity."""
        given: dict[str, Samples | None] = {kind: getattr(self, kind) for kind in KINDS}
        columns = {
            kind: each and (each.split(each.times), each.split(each.values))
            for kind, each in given.items()
        }
        for i in range(len(self)):
            yield {kind: each and (each[0][i], each[1][i]) for kind, each in columns.items()}

    def __str__(self) -> str:
        counts = []
        for kind in KINDS:
            if (samples := getattr(self, kind)) is not None:
                counts.append(f"{len(samples.times)} of {kind.replace('_', ' ')}")
        count = "1 trajectory" if len(self) == 1 else f"{len(self)} trajectories"
        text = f"{count}; samples: {', '.join(counts)}"
        return f"{text}; dropped: {'; '.join(self.dropped)}" if self.dropped else text

    def drop(self, names: Iterable[str], reason: str = "by request") -> "Recordings":
        """Without some trajectories, which are counted in `dropped`.

        Raises
        ------
        ValueError
            If there is no trajectory of that name, or none is left.
        """
        names = [names] if isinstance(names, str) else list(names)
        if unknown := [name for name in names if name not in self.names]:
            known = ", ".join(map(repr, self.names[:9])) + (", ..." if len(self) > 9 else "")
            raise ValueError(f"There is no trajectory {unknown[0]!r} to drop; there are {known}.")
        if not names:
            return self
        kept = [name not in names for name in self.names]
        if not any(kept):
            raise ValueError("Argument `names` must leave a trajectory, but names all.")
        words = f"trajectory {', '.join(names)} ({reason})"
        return stacked(
            [each for each, keep in zip(self, kept, strict=True) if keep],
            tuple(name for name, keep in zip(self.names, kept, strict=True) if keep),
            (*self.dropped, words),
        )

    def drop_samples(
        self,
        kind: str,
        samples: Bool[np.ndarray, " samples"],
        reason: str = "by request",
    ) -> "Recordings":
        """Without some samples of a quantity, which are counted in `dropped`.

        Parameters
        ----------
        kind
            `"attitude"` or `"angular_velocity"`.
        samples
            True where a sample is dropped (samples,), of all trajectories one after another.
        reason
            Why, in words.

        Raises
        ------
        ValueError
            If there is no such quantity or the shape is another.
        TypeError
            If `samples` are no booleans.
        """
        if kind not in SENSED or (given := getattr(self, kind)) is None:
            raise ValueError(f"Argument `kind` must be a recorded sensor, but is {kind!r}.")
        dropped = np.asarray(samples)
        if dropped.dtype != bool:
            raise TypeError(
                f"Argument `samples` must be boolean, True for what is dropped, but is of type "
                f"{dropped.dtype}."
            )
        if dropped.shape != given.times.shape:
            raise ValueError(
                f"Argument `samples` must have shape {given.times.shape}, but its shape is "
                f"{dropped.shape}."
            )
        if not dropped.any():
            return self
        kept = zip(
            given.split(~dropped), given.split(given.times), given.split(given.values), strict=True
        )
        remaining = [
            {**each, kind: (t[keep], value[keep])}
            for each, (keep, t, value) in zip(self, kept, strict=True)
        ]
        words = f"{dropped.sum()} samples of {kind.replace('_', ' ')} ({reason})"
        return stacked(remaining, self.names, (*self.dropped, words))


def stacked(
    trajectories: Sequence[OfTrajectory],
    names: tuple[str, ...],
    dropped: tuple[str, ...] = (),
) -> Recordings:
    """Trajectories side by side."""
    given = [kind for kind in GIVEN if any(each[kind] for each in trajectories)]
    for name, each in zip(names, trajectories, strict=True):
        require_complete(name, each, given)
    samples: dict[str, Samples | None] = dict.fromkeys(KINDS)
    empty = np.zeros(0), np.zeros((0,))
    for kind in KINDS:
        given = [each[kind] for each in trajectories]
        if any(each is not None for each in given):
            samples[kind] = Samples.stack([empty if each is None else each for each in given])
    return Recordings(**samples, names=names, dropped=dropped)
