"""From the signals of a log to recordings: units, axes, order and direction of attitudes."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..modules.units import FACTORS
from .quantities import (
    BODY_AXES,
    SPACE_AXES,
    UNITS_OF_QUANTITIES,
    between_axes,
    factor_between,
    standard_spelling,
)
from .signal import LogError, Signal

if TYPE_CHECKING:
    from ..identification import Recordings

INPUTS = "rotor_speed", "rotor_momentum", "body_torque"
IN_BODY_AXES = (
    *("angular_velocity", "specific_force", "magnetic_field", "direction"),
    *("body_torque", "rotor_momentum"),
)
IN_SPACE_AXES = ("position",)
MOMENTUM = "kg m²/s"
QUATERNIONS = "wxyz", "xyzw"
LEAST_RUN = 8  # samples of increasing times that may be a trajectory of their own
LENGTH_TOLERANCE = 1e-2  # of a quaternion
Samples = tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples *shape"]]


class Interval(NamedTuple):
    """A part of a log that becomes a trajectory."""

    name: str
    begin: float  # s
    end: float  # s


class Conventions(NamedTuple):
    """What a user says of signals, for what the file does not tell."""

    units: Mapping[str, str]
    frame: str | None
    space: str | None
    attitude_order: str | None
    attitude_direction: str | None


def make_recordings(
    path: str,
    signals: Mapping[str, Signal],
    conventions: Conventions,
    intervals: Sequence[Interval] | None,
    duplicates: Any,
    sensors: Any,
    provenance: Sequence[str],
) -> "Recordings":
    """Recordings of the signals of some quantities; see `Log.recordings`."""
    from ..identification import Recordings
    from ..identification.data.formats import (
        DIRECTIONS,
        known_formats,
        require_attitude_order,
        require_one_of,
    )
    from ..identification.data.sample_checks import DUPLICATES, column_counts, describe_counts

    require_one_of("duplicates", duplicates, DUPLICATES)
    if conventions.attitude_order is not None:
        require_attitude_order(conventions.attitude_order)
    if conventions.attitude_direction is not None:
        require_one_of("attitude_direction", conventions.attitude_direction, DIRECTIONS)
    words, dropped = list(provenance), list[str]()
    known = known_formats(sensors)
    for quantity, signal in signals.items():
        if quantity not in known:
            raise LogError(
                path, f"there is no quantity `{quantity}`; quantities are {', '.join(known)}"
            )
        place = f"signal `{signal.name}`"
        if not len(signal):
            raise LogError(path, "must have a sample, but has none", place)
        counts = column_counts(known[quantity])
        count = math.prod(signal.values.shape[1:])
        if quantity != "attitude" and count not in counts:
            wanted = f"must have {describe_counts(counts)} components as `{quantity}`"
            raise LogError(path, f"{wanted}, but has {count}", place)
    if unknown := set(conventions.units) - set(signals):
        raise LogError(
            path,
            f"units are given for {', '.join(sorted(unknown))}, which is not among the quantities "
            f"that are read, {', '.join(signals)}",
        )
    frame = _choose_axes("frame", conventions.frame, BODY_AXES, signals, words)
    space = _choose_axes("space", conventions.space, SPACE_AXES, signals, words)
    samples: dict[str, Samples] = {}
    for quantity, signal in signals.items():
        values = _in_units(path, quantity, signal, conventions, words)
        if quantity == "attitude":
            values = _as_rotations(path, signal, values, conventions, words)
        values = _in_axes(quantity, signal, values, frame, space)
        samples[quantity] = _in_order(path, quantity, signal.times, values, dropped)
    clocks = dict.fromkeys(signal.clock for signal in signals.values())
    if len(clocks) > 1:
        words.append(
            f"times of the clocks {', '.join(clocks)} are taken as times of one clock; a free "
            "time offset of a sensor tells whether they are"
        )
    stem = Path(path).stem
    words += [
        f"trajectory {part.name}: from {part.begin:.6g} to {part.end:.6g} s of the log"
        for part in intervals or ()
    ]
    names = [part.name for part in intervals or ()]
    if intervals is not None and (not names or len(set(names)) < len(names)):
        raise LogError(
            path, f"intervals must be there, each with a name of its own, but there are {names}"
        )
    parts = []
    for interval in intervals or [Interval(stem, -np.inf, np.inf)]:
        try:
            cut = _cut(samples, interval, duplicates, sensors, dropped)
            parts.append(Recordings.from_arrays(**cut, name=interval.name, sensors=sensors))
        except ValueError as error:
            raise LogError(path, str(error)) from error
    recordings = Recordings.concatenate(parts)
    return replace(recordings, dropped=(*recordings.dropped, *dropped), provenance=tuple(words))


def _in_units(
    path: str, quantity: str, signal: Signal, conventions: Conventions, words: list[str]
) -> np.ndarray:
    """The values in the unit of the library."""
    target = UNITS_OF_QUANTITIES.get(quantity, "")
    declared = standard_spelling(signal.unit)
    wanted = conventions.units.get(quantity)
    unit = declared if wanted is None else standard_spelling(wanted)
    about = f"{quantity.replace('_', ' ')} is `{signal.name}`"
    if quantity == "attitude" and _order(signal, conventions) in (*QUATERNIONS, ""):
        words.append(about)
        return signal.values
    if quantity == "rotor_momentum" and unit == MOMENTUM:
        words.append(f"{about}, in {unit}")
        return signal.values
    if not target:  # of a sensor of the user
        words.append(f"{about}, in {unit or 'a unit that the file does not tell'}")
        return signal.values
    if quantity == "rotor_speed" and unit == "1":  # a command is known but for a factor
        words.append(f"{about}, without unit")
        return signal.values
    if not unit:
        allowed = ", ".join([target, *_other_units(target)])
        raise LogError(
            path,
            f"must have a unit, but the file does not tell: say which, such as {allowed}, by "
            f"`units={{{quantity!r}: ...}}` or `--unit {quantity}=...`",
            f"signal `{signal.name}`",
        )
    factor = factor_between(unit, target)
    if factor is None:
        allowed = " or ".join([target, *_other_units(target)])
        raise LogError(
            path,
            f"must have a unit of {quantity.replace('_', ' ')}, {allowed}, but has {unit!r}; of "
            f'counts say the size, such as --unit {quantity}="0.061 {target}"',
            f"signal `{signal.name}`",
        )
    if wanted is None:
        words.append(f"{about}, in {unit}")
    elif declared in ("", unit):
        words.append(f"{about}, in {unit} as given")
    else:
        words.append(f"{about}, in {unit} as given (the file says {declared})")
        warnings.warn(f"{path}: {words[-1]}", stacklevel=4)
    return signal.values * factor


def _other_units(unit: str) -> list[str]:
    return list(FACTORS.get(unit, {}))


def _order(signal: Signal, conventions: Conventions) -> str:
    return conventions.attitude_order or signal.order


def _as_rotations(
    path: str, signal: Signal, values: np.ndarray, conventions: Conventions, words: list[str]
) -> np.ndarray:
    """Rotations (samples, 3, 3) from body to space; NaN where a sample is missing."""
    from scipy.spatial.transform import Rotation

    place = f"signal `{signal.name}`"
    order = _order(signal, conventions)
    direction = conventions.attitude_direction or signal.direction
    columns = values.reshape(len(values), -1)
    if columns.shape[1] == 9:
        order = "matrix"
    elif not order:
        raise LogError(
            path,
            "must have an order, but the file does not tell: say 'wxyz', 'xyzw', "
            "'rotation_vector' or the axes of angles such as 'ZYX' by `attitude_order=`",
            place,
        )
    counts = {"wxyz": 4, "xyzw": 4, "matrix": 9}
    if columns.shape[1] != counts.get(order, 3):
        words_of_count = f"must have {counts.get(order, 3)} components for the order {order!r}"
        raise LogError(path, f"{words_of_count}, but has {columns.shape[1]}", place)
    rotations = np.full((len(columns), 3, 3), np.nan)
    present = np.isfinite(columns).all(1)
    numbers = columns[present]
    if order in QUATERNIONS:
        lengths = np.linalg.norm(numbers, axis=1)
        if np.any(wrong := abs(lengths - 1) > LENGTH_TOLERANCE):
            i = int(np.flatnonzero(present)[np.argmax(wrong)])
            problem = f"must have unit quaternions, but one has the length {lengths[wrong][0]:.4g}"
            raise LogError(path, problem, f"{place}, {signal.times[i]:.9g} s")
        matrices = Rotation.from_quat(numbers, scalar_first=order == "wxyz").as_matrix()
    elif order == "matrix":
        matrices = numbers.reshape(-1, 3, 3)
    elif order == "rotation_vector":
        matrices = Rotation.from_rotvec(numbers).as_matrix()
    else:
        matrices = Rotation.from_euler(order, numbers).as_matrix()
    if not direction:
        words.append("attitudes are assumed to be from body to space, as the file does not tell")
    if direction == "space to body":
        matrices = np.swapaxes(matrices, 1, 2)
    rotations[present] = matrices
    words.append(f"attitudes are in the order {order}, {direction or 'body to space'}")
    return rotations


def _choose_axes(
    kind: str,
    wanted: str | None,
    known: Mapping[str, np.ndarray],
    signals: Mapping[str, Signal],
    words: list[str],
) -> str:
    """The axes of the recordings: those wanted, or those of the first signal that tells."""
    of = "body" if kind == "frame" else "space"
    quantities = "attitude", *(IN_BODY_AXES if kind == "frame" else IN_SPACE_AXES)
    concerned = {
        name: getattr(signal, kind) for name, signal in signals.items() if name in quantities
    }
    declared = [axes for axes in concerned.values() if axes]
    if wanted is not None and wanted not in (*known, *declared):
        names = ", ".join([*known, *declared])
        raise ValueError(f"Argument `{kind}` must be one of {names}, but is {wanted!r}.")
    chosen = wanted or (declared[0] if declared else "")
    for name, axes in concerned.items():
        label = name.replace("_", " ")
        if chosen and not axes:
            words.append(f"{label} is assumed to be in the axes {chosen} of the {of}")
        elif axes != chosen and axes in known and chosen in known:
            words.append(f"{label} is turned from the axes {axes} to {chosen}")
        elif axes != chosen:
            raise ValueError(
                f"Argument `{kind}` must be axes to which those of all signals can be turned, but "
                f"{label} is in the axes {axes!r}, and others in {chosen!r}."
            )
    if concerned:
        words.append(f"axes of the {of}: {chosen or 'those of the file, which does not name them'}")
    return chosen


def _in_axes(
    quantity: str, signal: Signal, values: np.ndarray, frame: str, space: str
) -> np.ndarray:
    """The values in the axes of the recordings."""
    if quantity in ("attitude", *IN_BODY_AXES):
        body = between_axes(BODY_AXES, signal.frame or frame, frame)
        if quantity == "attitude":
            return between_axes(SPACE_AXES, signal.space or space, space) @ values @ body.T
        return values @ body.T if values.ndim == 2 and values.shape[1] == 3 else values
    if quantity in IN_SPACE_AXES:
        return values @ between_axes(SPACE_AXES, signal.space or space, space).T
    return values


def _in_order(
    path: str, quantity: str, t: np.ndarray, values: np.ndarray, dropped: list[str]
) -> Samples:
    """Samples that have numbers, in the order of their times."""
    label = quantity.replace("_", " ")
    present = np.isfinite(values.reshape(len(t), -1)).all(1) & np.isfinite(t)
    if missing := int(np.sum(~present)):
        dropped.append(f"{missing} samples of {label} (without a number)")
    t, values = t[present], values[present]
    if np.any(np.diff(t) < 0):
        if begins := _count_new_beginnings(t):
            raise LogError(
                path,
                f"must have times that increase, but they begin again ({begins} times): are there "
                "several trajectories in one file? `--trajectory COLUMN` tells the column of their "
                "names in a CSV file, in Python `Recordings.from_csv(..., trajectory=...)`; or "
                "split the file",
                quantity.replace("_", " "),
            )
        dropped.append(f"the order of samples of {label} (sorted by their times)")
        order = np.argsort(t, kind="stable")
        t, values = t[order], values[order]
    return t, values


def _count_new_beginnings(t: np.ndarray) -> int:
    """How often times go back for a long run that passes most of the times of the run before."""
    runs = np.split(t, np.flatnonzero(np.diff(t) < 0) + 1)
    runs = [(run[0], run[-1]) for run in runs if len(run) >= LEAST_RUN]
    both = [min(a[1], b[1]) - max(a[0], b[0]) for a, b in pairwise(runs)]
    shorter = [min(a[1] - a[0], b[1] - b[0]) for a, b in pairwise(runs)]
    return int(np.sum(np.array(both) > np.array(shorter) / 2))


def _cut(
    samples: Mapping[str, Samples],
    interval: Interval,
    duplicates: Any,
    sensors: Any,
    dropped: list[str],
) -> dict[str, Samples]:
    """The samples in an interval, without two at one time; inputs go a sample beyond."""
    from ..identification.data.formats import known_formats
    from ..identification.data.sample_checks import SampleError, readings_by_time

    formats, part = known_formats(sensors), {}
    begin, end = interval.begin, interval.end
    for quantity in INPUTS:  # readings need inputs at their times
        if quantity in samples and len(t := samples[quantity][0]):
            begin, end = max(begin, t[0]), min(end, t[-1])
    for quantity, (t, _) in samples.items():
        asked = int(np.sum((interval.begin <= t) & (t <= interval.end)))
        cut = asked - int(np.sum((begin <= t) & (t <= end)))
        if quantity not in INPUTS and cut:
            dropped.append(
                f"{cut} samples of {quantity.replace('_', ' ')} (no input at their time)"
            )
    for quantity, (t, values) in samples.items():
        first, last = np.searchsorted(t, begin, "left"), np.searchsorted(t, end, "right")
        if quantity in INPUTS:
            first, last = max(np.searchsorted(t, begin, "right") - 1, 0), last + 1
        if last <= first:
            continue
        columns = values[first:last].reshape(-1, math.prod(values.shape[1:]))
        try:
            part[quantity] = readings_by_time(duplicates, formats[quantity], t[first:last], columns)
        except SampleError as problem:
            raise ValueError(
                f"`{quantity}` {problem.words}, in interval {interval.name!r}"
            ) from None
        if twice := len(columns) - len(part[quantity][0]):
            dropped.append(f"{twice} samples of {quantity.replace('_', ' ')} (same time)")
    if not set(part) - set(INPUTS):
        ends = [(t[0], t[-1]) for t, _ in samples.values() if len(t)]
        span = f"{min(ends)[0]:.9g} to {max(last for _, last in ends):.9g} s" if ends else "nothing"
        asked = f"from {interval.begin:.9g} to {interval.end:.9g} s"
        raise ValueError(
            f"interval {interval.name!r} {asked} must have samples, but the log has {span}"
        )
    return part
