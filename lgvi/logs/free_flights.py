"""Parts of a log in which the body flies free: found by the accelerometer, or as in a table."""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..modules.units import STANDARD_GRAVITY
from .contents import GAP, is_saturated, median_interval, white_noise
from .conversion import Interval
from .delimited.dialect import NUMBERS
from .delimited.text_files import decode
from .log import Log
from .quantities import BODY_AXES, UNITS_OF_QUANTITIES, between_axes, factor_between
from .signal import LogError, Signal

# What free flight may leave unexplained in the specific force:
TOLERANCE = 0.5  # m/s², by itself
LAG = 0.1  # in parts of it, by errors of scale and of times
MOST_TOLERANCE = 0.3 * STANDARD_GRAVITY  # less than what holds a body
BIAS = 1.5  # m/s², of the accelerometer, with the drag
SHARPEST = 0.2  # m/s², that is allowed where the flight around leaves next to nothing
LOW = 0.2 * STANDARD_GRAVITY  # specific force in free flight, where there is no gyroscope
LEAST_BY_FORCE = 0.25  # s, where there is none: a runner is in the air for up to 0.2 s
LEVER = 0.1  # m: an angular acceleration counts as the acceleration at its end
JOLT = 10.0  # rad/s², of the angular acceleration beyond that of a free body
SPAN = 0.005  # s, to both sides, of differences of angular velocities
STUCK = 0.1  # s, for which a sensor that reads does not stay at the same numbers
STILL, LYING = 0.2, 0.3  # rad/s, and s for which a body that lies turns no faster
BREAK = 0.01  # s: a shorter gap hides no contact, as what turns the body in it is seen after it
PARTS = 4  # of a window: the next one begins a part later
CHUNK = 1000  # parts for which the equations are held at once
TIMES = "from", "to"  # columns of a table
SEPARATORS = ",", ";", "\t"  # of its cells
# Symmetric matrices without trace, of unit length and at right angles.
DEVIATORS = np.array(
    [
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        np.diag([1, 1, -2]) / np.sqrt(3),
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ]
) / np.sqrt(2)


class FreeFlight(Interval):
    """A part of a log in which a body flies free: `name, begin, end = flight`.

    Attributes
    ----------
    name
        Name of the trajectory: its number, from 1, or as in the table.
    begin, end
        First and last time, s.
    words
        How it was found, and how well free flight explains it.
    """

    words: str

    def __new__(cls, name: str, begin: float, end: float, words: str = "") -> "FreeFlight":
        flight = super().__new__(cls, name, begin, end)
        flight.words = words
        return flight


class Motion(NamedTuple):
    """What the sensors read at the times of the accelerometer; NaN where they do not tell."""

    t: Float[np.ndarray, " samples"]  # s
    force: Float[np.ndarray, "samples 3"]  # m/s²
    omega: Float[np.ndarray, "samples 3"]  # rad/s
    alpha: Float[np.ndarray, "samples 3"]  # rad/s², the derivative of omega
    noise: float  # m/s², of the force and of the angular acceleration at the lever


def find_free_flights(
    log: Log,
    *,
    specific_force: str | Sequence[str] | None = None,
    angular_velocity: str | Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    least: float = 0.15,
    margin: float = 0.01,
    reach: float = 0.15,
) -> tuple[FreeFlight, ...]:
    r"""Find the parts of a log in which the body flies free: thrown or dropped, and not yet caught.

    In free flight nothing holds the body. Gravity is not felt: an accelerometer at the place $r$
    from the centre of mass reads

    $$f = \dot\omega \times r + \omega \times (\omega \times r) + b$$

    with a small bias $b$, in which the drag is, and nothing turns the body but its inertia $J$,

    $$J \dot\omega + \omega \times J \omega = 0.$$

    A part of the log is free flight if one $r$, not longer than `reach`, one $b$ and one $J$
    explain it, by linear least squares; where they cease to is the release or the catch. A body
    that is held, or lies, feels its weight, which turns as the body does: no $r$ and $b$ explain
    that.

    Without a gyroscope only flights of 0.25 s and more with specific forces below 0.2 g are found:
    those of a slow spin, or with the accelerometer near the centre of mass. A contact that is as
    light is not seen.

    Parameters
    ----------
    log
        The log.
    specific_force, angular_velocity
        Names of signals, or of their components. By default the first of the log that is this
        quantity by the documentation of the format; the gyroscope with the clock of the
        accelerometer, if there is one.
    units
        Units by quantity, where the file does not tell, such as `{"specific_force": "g"}`.
    least
        Shortest free flight, s.
    margin
        Time, s, that is cut off at both ends of what is explained.
    reach
        Largest distance of the accelerometer from the centre of mass, m.

    Returns
    -------
    tuple of FreeFlight
        In the order of time. Gaps, samples in which a sensor reads its limit, and those in which
        it is stuck, are in none.

    Raises
    ------
    LogError
        If the log has no accelerometer, or a unit is needed that the file does not tell, or seems
        to be wrong: what lies still reads 1 instead of 9.8 m/s².
    ValueError
        If `least` or `reach` is not above zero, `margin` is below zero, or one is not finite.

    Notes
    -----
    A body with rotors or wheels that spin is not explained by an inertia: say where its flights
    are. An acceleration without gravity, as phones write it too, is no specific force: it is zero
    at rest, which looks like free flight.
    """
    for name, value, is_right in (
        ("least", least, 0 < least < np.inf),
        ("margin", margin, 0 <= margin < np.inf),
        ("reach", reach, 0 < reach < np.inf),
    ):
        if not is_right:
            bound = "at least 0" if name == "margin" else "above 0"
            raise ValueError(f"Argument `{name}` must be finite and {bound}, but is {value!r}.")
    force = _signal(log, "specific_force", specific_force, "")
    if force is None:
        raise LogError(
            log.path,
            "must have an accelerometer, for free flights to be found, but no signal is known to "
            "be one: name it by `specific_force=`, or say when the flights are, by `--from` and "
            "`--to` or by a table of times",
        )
    turning = _signal(log, "angular_velocity", angular_velocity, force.clock)
    motion = _motion(log, force, turning, units or {})
    t = motion.t
    if len(t) < 2:
        return ()
    if turning is None:
        parts = _low_parts(motion, max(least, LEAST_BY_FORCE))
    else:
        _require_weight(log, force, motion)
        parts = _explained_parts(motion, least, reach)
    flights: list[FreeFlight] = []
    for first, stop, words in parts:
        begin, end = float(t[first] + margin), float(t[stop - 1] - margin)
        if end - begin >= least:
            flights.append(FreeFlight(str(len(flights) + 1), begin, end, words))
    return tuple(flights)


def _require_weight(log: Log, force: Signal, motion: Motion) -> None:
    """Check that a body which lies does not read 1 m/s², as it does in units of g."""
    is_still = np.linalg.norm(motion.omega, axis=1) <= STILL
    lying = [motion.force[begin:end] for begin, end in _without_gaps(is_still, motion.t, LYING)]
    if not lying:
        return
    felt = np.nanmedian(np.linalg.norm(np.concatenate(lying), axis=1))
    if 0.9 < felt < 1.1:
        raise LogError(
            log.path,
            f"reads {felt:.2f} m/s² while the body does not turn, and must read 9.8 m/s² while it "
            "lies: its unit may be g",
            f"signal `{force.name}`",
        )


def _signal(
    log: Log, quantity: str, names: str | Sequence[str] | None, clock: str
) -> Signal | None:
    """The signal of the names, or the first of a quantity, rather with a clock."""
    if names is not None:
        return log.signal(names)
    signals = [signal for signal in log.signals.values() if signal.quantity == quantity]
    return min(signals, key=lambda signal: signal.clock != clock, default=None)


def _readings(
    log: Log, quantity: str, signal: Signal, units: Mapping[str, str]
) -> tuple[np.ndarray, np.ndarray]:
    """Times in order, and values in the unit of the library; NaN where at the limit or stuck."""
    place = f"signal `{signal.name}`"
    if signal.values.shape[1:] != (3,):
        count = int(np.prod(signal.values.shape[1:]))
        raise LogError(log.path, f"must have three components, but has {count}", place)
    unit, target = units.get(quantity, signal.unit), UNITS_OF_QUANTITIES[quantity]
    factor = factor_between(unit, target)
    if factor is None:
        words = f"but has {unit!r}" if unit else "but the file does not tell it"
        raise LogError(
            log.path,
            f"must have a unit of {quantity.replace('_', ' ')}, such as {target}, {words}: say it "
            f"by `units={{{quantity!r}: ...}}` or `--unit {quantity}=...`",
            place,
        )
    present = np.isfinite(signal.values).all(1) & np.isfinite(signal.times)
    t, i = np.unique(signal.times[present], return_index=True)
    values = signal.values[present][i]
    is_same = np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])[: len(t)]
    readings = values * factor
    readings[is_saturated(values, signal.limit)] = np.nan
    for begin, end in _without_gaps(is_same, t, STUCK):
        readings[begin:end] = np.nan
    return t, readings


def _motion(log: Log, force: Signal, turning: Signal | None, units: Mapping[str, str]) -> Motion:
    """Readings of both sensors at the times of the accelerometer."""
    t, f = _readings(log, "specific_force", force, units)
    if turning is None:
        return Motion(t, f, np.zeros_like(f), np.zeros_like(f), _noise(f))
    times, omega = _readings(log, "angular_velocity", turning, units)
    if turning.frame != force.frame and turning.frame and force.frame:
        if not {turning.frame, force.frame} <= BODY_AXES.keys():
            words = f"must be in the axes of `{force.name}`, {force.frame!r}, or in axes that can "
            words += f"be turned to them, but is in {turning.frame!r}"
            raise LogError(log.path, words, f"signal `{turning.name}`")
        omega = omega @ between_axes(BODY_AXES, turning.frame, force.frame).T
    h = median_interval(times)
    k = max(1, round(SPAN / h)) if h > 0 else 1
    if len(times) <= 2 * k:
        nothing = np.full_like(f, np.nan)
        return Motion(t, f, nothing, nothing, _noise(f))
    alpha = np.full_like(omega, np.nan)
    alpha[k:-k] = (omega[2 * k :] - omega[: -2 * k]) / (times[2 * k :] - times[: -2 * k])[:, None]
    after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    is_in_gap = times[after] - times[after - 1] > max(GAP * h, BREAK)
    omega_at_t, alpha_at_t = (
        np.column_stack([np.interp(t, times, x, np.nan, np.nan) for x in values.T])
        for values in (omega, alpha)
    )
    omega_at_t[is_in_gap] = np.nan
    alpha_noise = np.sqrt(0.5) * _noise(omega) / (k * h)
    return Motion(t, f, omega_at_t, alpha_at_t, float(np.hypot(_noise(f), LEVER * alpha_noise)))


def _noise(values: Float[np.ndarray, "samples 3"]) -> float:
    """The length of the white noise of a vector."""
    return float(np.linalg.norm([np.nan_to_num(white_noise(x[np.isfinite(x)])) for x in values.T]))


def _stretches(which: Bool[np.ndarray, " rows"]) -> Iterator[tuple[int, int]]:
    """Where a mask is true: begin and end, which is the first row after."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]])))
    yield from zip(steps[::2].tolist(), steps[1::2].tolist(), strict=True)


def _without_gaps(
    which: Bool[np.ndarray, " samples"], t: Float[np.ndarray, " samples"], least: float
) -> Iterator[tuple[int, int]]:
    """Where a mask is true without a gap, for some time at least: begin and end."""
    is_joined = which[1:] & which[:-1] & (np.diff(t) <= max(GAP * median_interval(t), BREAK))
    for begin, last in _stretches(is_joined):
        if t[last] - t[begin] >= least:
            yield begin, last + 1


def _low_parts(motion: Motion, least: float) -> Iterator[tuple[int, int, str]]:
    """Rows in which next to nothing is felt."""
    is_low = np.linalg.norm(motion.force, axis=1) <= LOW
    for begin, end in _without_gaps(is_low, motion.t, least):
        yield begin, end, "specific force below 0.2 g; there is no gyroscope"


def _explained_parts(motion: Motion, least: float, reach: float) -> Iterator[tuple[int, int, str]]:
    """Rows which one place of the accelerometer, one bias and one inertia explain."""
    f, omega, alpha = (np.linalg.norm(x, axis=1) for x in motion[1:4])
    is_possible = f <= reach * (omega**2 + alpha) + BIAS + _tolerance(motion, f)
    # Of each principal axis |alpha| <= |omega| |omega| of the two others.
    is_possible &= LEVER * (alpha - omega**2 / np.sqrt(3) - JOLT) <= 3 * motion.noise
    size = max(2, round(least / (PARTS * median_interval(motion.t))))
    for first, stop in _without_gaps(is_possible, motion.t, least):
        for begin, end in _explained_windows(motion, first, stop, size, reach):
            begin = max(begin, first)
            while end - begin >= PARTS * size:
                near = max(first, begin - PARTS * size), min(stop, end + PARTS * size)
                flight = _grow(motion, begin, end, *near, reach)
                if flight is None:
                    break
                yield flight
                first = begin = flight[1]


def _tolerance(motion: Motion, size: Float[np.ndarray, " *rows"]) -> Float[np.ndarray, " *rows"]:
    """What may be left unexplained in a sample whose readings have a size, m/s²."""
    return np.minimum(TOLERANCE + LAG * size + 3 * motion.noise, MOST_TOLERANCE)


def _equations(motion: Motion, begin: int, end: int) -> Float[np.ndarray, "rows 6 12"]:
    """The matrix of the unknowns and, as its last column, what is read, m/s².

    Unknown are the place r, the bias b, and D, by which the inertia over a third of its trace
    differs from the unit matrix: alpha x r + omega x (omega x r) + b = f, and
    D alpha + omega x D omega = -alpha, times the lever.
    """
    omega, alpha = motion.omega[begin:end], motion.alpha[begin:end]
    unit = np.eye(3)
    of_euler = np.swapaxes(np.cross(alpha[:, None], unit), 1, 2)
    squares = np.sum(omega**2, axis=1)[:, None, None]
    equations = np.zeros((len(omega), 6, 12))
    equations[:, :3, :3] = of_euler + omega[:, :, None] * omega[:, None] - squares * unit
    equations[:, :3, 3:6] = unit
    for column, D in enumerate(DEVIATORS, 6):
        equations[:, 3:, column] = LEVER * (alpha @ D + np.cross(omega, omega @ D))
    equations[:, :3, 11] = motion.force[begin:end]
    equations[:, 3:, 11] = -LEVER * alpha
    return equations


def _solve(
    products: Float[np.ndarray, "*fits 12 12"], reach: float
) -> tuple[Float[np.ndarray, "*fits 11"], Float[np.ndarray, " *fits"], Bool[np.ndarray, " *fits"]]:
    """The unknowns by least squares, from the products of the equations.

    Also the root of the mean square that they leave unexplained, m/s², and whether the place and
    the bias are small enough. Where the motion does not tell the unknowns, they are drawn to zero.
    """
    count = products[..., 3, 3]  # samples: the bias is in each once
    products = products / count[..., None, None]
    matrix, right = products[..., :11, :11], products[..., :11, 11]
    weight = np.diag((TOLERANCE / np.repeat([reach, BIAS, 1.0], [3, 3, 5])) ** 2)
    x = np.linalg.solve(matrix + weight, right[..., None])[..., 0]
    explained = np.sum(x * (2 * right - (matrix @ x[..., None])[..., 0]), axis=-1)
    left = np.sqrt(np.maximum(products[..., 11, 11] - explained, 0))
    place, bias = np.linalg.norm(x[..., :3], axis=-1), np.linalg.norm(x[..., 3:6], axis=-1)
    return x, left, (place <= reach) & (bias <= BIAS)


def _products(equations: Float[np.ndarray, "*fits rows 6 12"]) -> Float[np.ndarray, "*fits 12 12"]:
    """Sums of the products of each two columns."""
    equations = equations.reshape(*equations.shape[:-3], -1, 12)
    return np.swapaxes(equations, -1, -2) @ equations


def _explained_windows(
    motion: Motion, begin: int, end: int, size: int, reach: float
) -> Iterator[tuple[int, int]]:
    """Rows of windows, of so many parts of a size, that free flight explains; joined."""
    count = (end - begin) // size
    if count < PARTS:
        return
    products = []
    for part in range(0, count, CHUNK):
        parts = min(CHUNK, count - part)
        first = begin + part * size
        equations = _equations(motion, first, first + parts * size)
        products.append(_products(equations.reshape(parts, size, 6, 12)))
    of_windows = np.lib.stride_tricks.sliding_window_view(np.concatenate(products), PARTS, axis=0)
    products = of_windows.sum(-1)
    _, left, is_near = _solve(products, reach)
    size_of_readings = np.sqrt(products[:, 11, 11] / products[:, 3, 3])
    most = np.hypot(0.5 * (TOLERANCE + LAG * size_of_readings), 1.2 * motion.noise)
    for i, j in _stretches(is_near & (left <= np.minimum(most, 0.5 * MOST_TOLERANCE))):
        yield begin + i * size, begin + (j - 1 + PARTS) * size


def _grow(
    motion: Motion, begin: int, end: int, low: int, high: int, reach: float
) -> tuple[int, int, str] | None:
    """The rows around a core, within low and high, which the unknowns of the core explain."""
    equations = _equations(motion, low, high)
    size = np.linalg.norm(equations[:, :, 11], axis=1)
    x, left, is_near = _solve(_products(equations[begin - low : end - low]), reach)
    for _ in range(5):  # it settles in two or three
        departure = np.linalg.norm(equations[:, :, 11] - equations[:, :, :11] @ x, axis=1)
        # What the core leaves is sharper than the tolerance, which must do for any flight.
        fits = departure <= np.minimum(_tolerance(motion, size), 3 * left + SHARPEST)
        common, *rows = max(
            (
                (min(low + j, end) - max(low + i, begin), low + i, low + j)
                for i, j in _stretches(fits)
            ),
            default=(0, begin, end),
        )
        if common <= 0:
            return None
        if rows == [begin, end]:
            break
        begin, end = rows
        x, left, is_near = _solve(_products(equations[begin - low : end - low]), reach)
    if not is_near:
        return None
    spin = np.median(np.linalg.norm(motion.omega[begin:end], axis=1))
    place = np.linalg.norm(x[:3])
    words = f"turning at {spin:.2g} rad/s, {left:.2g} m/s² not explained"
    if place * spin**2 > TOLERANCE:
        words += f", accelerometer {100 * place:.1f} cm from the centre of mass"
    return begin, end, words


def read_intervals(path: str | PathLike[str]) -> tuple[FreeFlight, ...]:
    """Read a table of times: which parts of a log are flights.

    Parameters
    ----------
    path
        Text with commas, semicolons or tabs between the cells (CSV): the columns `from` and `to`,
        s, and a column `name` if flights have names other than their numbers. The decimal mark may
        be a comma, unless commas are between the cells.

    Returns
    -------
    tuple of FreeFlight
        In the order of the table.

    Raises
    ------
    LogError
        If a column is missing or not known, a time is no number, a flight ends before it begins,
        two overlap, or two have one name. The message names the line and the column.
    """
    path = Path(path)
    text = decode(path, path.stem, path.read_bytes()).content.decode()
    delimiter = max(SEPARATORS, key=text.partition("\n")[0].count)
    reader = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)
    rows: list[tuple[str, dict[str, str]]] = []
    try:
        header = [name.strip() for name in next(reader, [])]
        if sorted({*header} - {"name"}) != [*TIMES] or len({*header}) < len(header):
            names = f"{header}"[:200]
            words = f"must have the columns `from`, `to` and perhaps `name`, but has {names}"
            raise LogError(path, words, "line 1")
        for cells in reader:
            place = f"line {reader.line_num}"
            if not any(map(str.strip, cells)):
                continue
            if len(cells) != len(header):
                raise LogError(path, f"must have {len(header)} cells, but has {len(cells)}", place)
            rows.append((place, dict(zip(header, map(str.strip, cells), strict=True))))
    except csv.Error as error:
        words = f"must be a table, but cannot be read: {error}"
        raise LogError(path, words, f"line {reader.line_num}") from error
    times = [row[column] for _, row in rows for column in TIMES]
    decimal = "," if delimiter != "," and any("," in time for time in times) else "."
    flights: dict[str, FreeFlight] = {}
    for place, row in rows:
        begin, end = (_time(path, place, column, row[column], decimal) for column in TIMES)
        if end <= begin:
            words = f"must be after {begin:.9g} s, but is {end:.9g} s"
            raise LogError(path, words, f"{place}, column `to`")
        name = row.get("name") or str(len(flights) + 1)
        if name in flights:
            words = f"must be another name than in {flights[name].words}, but is {name[:40]!r}"
            raise LogError(path, words, f"{place}, column `name`")
        flights[name] = FreeFlight(name, begin, end, place)
    if not flights:
        raise LogError(path, "must have a flight in a line at least, but has none")
    for flight, after in pairwise(sorted(flights.values(), key=lambda flight: flight.begin)):
        if after.begin < flight.end:
            words = f"must not overlap with another flight, but does with that of {flight.words}"
            raise LogError(path, words, after.words)
    return tuple(flights.values())


def _time(path: Path, place: str, column: str, cell: str, decimal: str) -> float:
    time = float(cell.replace(",", ".")) if NUMBERS[decimal].fullmatch(cell) else math.nan
    if not math.isfinite(time):
        words = f"must be a time, s, but is {cell[:40]!r}"
        raise LogError(path, words, f"{place}, column `{column}`")
    return time
