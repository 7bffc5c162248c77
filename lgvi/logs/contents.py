"""What is in a log: rates, gaps, saturation, resolution and noise of each signal."""

import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from .log import Log
from .signal import Signal

GAP = 2.5  # median intervals: a longer one is a gap
UNEVEN = 0.1  # deviation of the intervals, in parts of the median one, that is worth a warning
FEW_LEVELS = 50  # between the lowest and the highest value
LONG_RUN = 4  # equal extreme values in a row that are more than chance
STEEP = 3  # steps of the resolution from an extreme value to the sample before or after
MOST_LEVELS = 100_000  # samples from which the resolution is read
WIDTH = 100  # columns of a terminal
COLUMNS = "samples", "from (s)", "to (s)", "Hz", "unit", "lowest", "highest", "step", "noise"
NAME_WIDTH = 22


@dataclass(frozen=True)
class SignalContents:
    """What the samples of a signal look like.

    Attributes
    ----------
    samples
        Number of samples.
    unit, quantity, components
        As in the [`Signal`][lgvi.logs.Signal]; components that have no name are numbered.
    begin, end
        First and last time, s; NaN without samples.
    rate
        Samples in a second, by the median interval; NaN if unknown.
    jitter
        Standard deviation of the intervals that are no gaps, s.
    gaps
        Intervals (begin, end), s, that are longer than two and a half median ones.
    duplicates
        Number of times that are equal to the one before.
    backward
        Number of times that are before the one before.
    missing
        Number of samples that hold a NaN.
    lowest, highest
        Range of each component.
    saturated
        Part of the samples with a component at the limit of the sensor. Where the limit is not
        known, extreme values that repeat in a row and are entered steeply count as the limit.
    step
        Resolution of each component: its values differ by multiples of it. NaN if there is none.
    noise
        Standard deviation of white noise of each component, by third differences, or by the
        rounding if that is more. NaN where the motion is too fast for the rate to tell it apart.
    constant
        Names of the components that never change.
    """

    samples: int
    unit: str
    quantity: str
    components: tuple[str, ...]
    begin: float
    end: float
    rate: float
    jitter: float
    gaps: tuple[tuple[float, float], ...]
    duplicates: int
    backward: int
    missing: int
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    saturated: float
    step: tuple[float, ...]
    noise: tuple[float, ...]
    constant: tuple[str, ...]

    def warnings(self) -> list[str]:
        """What to be careful with, in words."""
        return list(_warnings(self))


@dataclass(frozen=True)
class Contents:
    """What is in a log; `str` of it is a table with warnings.

    Attributes
    ----------
    path, kind, start, assumed
        As in the [`Log`][lgvi.logs.Log]; the start as text, empty if the file does not tell.
    signals
        The signals by name.
    begin, end
        First and last time of all signals, s; NaN without samples.
    disarmed
        Intervals (begin, end), s, in which the vehicle was not armed; None if the file does not
        tell.
    """

    path: str
    kind: str
    start: str
    assumed: tuple[str, ...]
    signals: dict[str, SignalContents]
    begin: float
    end: float
    disarmed: tuple[tuple[float, float], ...] | None

    def as_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, words and numbers, as for JSON: NaN is None."""
        return _plain(asdict(self))

    def __str__(self) -> str:
        return "\n".join(_lines(self))


def describe(log: Log) -> Contents:
    """What is in a log: rates, gaps, saturation, resolution and noise of each signal.

    Parameters
    ----------
    log
        The log.

    Returns
    -------
    Contents
        A description of each signal. Print it, or take `as_dict` for JSON.
    """
    signals = {name: _describe_signal(signal) for name, signal in log.signals.items()}
    filled = [signal for signal in signals.values() if np.isfinite(signal.begin)]
    begin = min((signal.begin for signal in filled), default=np.nan)
    end = max((signal.end for signal in filled), default=np.nan)
    start = "" if log.start is None else log.start.isoformat(sep=" ")
    disarmed = None if log.armed is None else tuple(_outside(log.armed, begin, end))
    return Contents(
        str(log.path), log.kind, start, tuple(log.assumed), signals, begin, end, disarmed
    )


def _outside(
    intervals: tuple[tuple[float, float], ...], begin: float, end: float
) -> Iterator[tuple[float, float]]:
    """What intervals leave of the time from begin to end."""
    for first, last in sorted(intervals):
        if first > begin:
            yield begin, min(first, end)
        begin = max(begin, last)
        if begin >= end:
            return
    if begin < end:
        yield begin, end


def _describe_signal(signal: Signal) -> SignalContents:
    t = signal.times[np.isfinite(signal.times)]
    values = signal.values.reshape(len(signal), int(np.prod(signal.values.shape[1:])))
    names = signal.components
    if len(names) != values.shape[1]:
        names = tuple(str(i) for i in range(values.shape[1])) if values.shape[1] > 1 else ("",)
    present = np.isfinite(values)
    numbers = [column[is_there] for column, is_there in zip(values.T, present.T, strict=True)]
    interval = np.diff(t)
    median = median_interval(t)
    is_gap = interval > GAP * median
    regular = interval[(interval > 0) & ~is_gap]
    step = [_resolution(x) for x in numbers]
    return SignalContents(
        samples=len(signal),
        unit=signal.unit,
        quantity=signal.quantity,
        components=names,
        begin=float(t.min()) if len(t) else np.nan,
        end=float(t.max()) if len(t) else np.nan,
        rate=1 / median,
        jitter=float(np.std(regular)) if len(regular) else np.nan,
        gaps=tuple(zip(t[:-1][is_gap].tolist(), t[1:][is_gap].tolist(), strict=True)),
        duplicates=int(np.sum(interval == 0)),
        backward=int(np.sum(interval < 0)),
        missing=int(np.sum(~present.all(1))),
        lowest=tuple(float(x.min()) if len(x) else np.nan for x in numbers),
        highest=tuple(float(x.max()) if len(x) else np.nan for x in numbers),
        saturated=float(np.mean(is_saturated(values, signal.limit))) if len(values) else 0.0,
        step=tuple(step),
        noise=tuple(
            _noise_with_rounding(x, a_step) for x, a_step in zip(numbers, step, strict=True)
        ),
        constant=tuple(
            name
            for name, x in zip(names, numbers, strict=True)
            if len(x) > 1 and x.min() == x.max()
        ),
    )


def median_interval(t: Float[np.ndarray, " samples"]) -> float:
    """The median of the intervals above zero, s; NaN if there are none."""
    interval = np.diff(t)
    interval = interval[interval > 0]
    return float(np.median(interval)) if len(interval) else np.nan


def is_saturated(
    values: Float[np.ndarray, "samples components"], limit: float = np.nan
) -> Bool[np.ndarray, " samples"]:
    """Which samples have a component at the limit of the sensor.

    Parameters
    ----------
    values
        Values (samples, components).
    limit
        Largest absolute value that the sensor can read. If it is NaN, extreme values count as the
        limit if they repeat in a row, longer than other values do, and if the value before or
        after such a row is several steps of the resolution away, unlike at the top of a smooth
        curve.
    """
    if np.isfinite(limit):
        # Of a signed integer with 16 bits the largest is 32767, and the limit often 32768.
        return np.any(np.abs(values) >= 0.999 * limit, axis=1)
    saturated = np.zeros(len(values), bool)
    for x in values.T:
        largest = np.max(np.abs(x[np.isfinite(x)]), initial=0.0)
        for y in (x, -x):
            top = np.max(y[np.isfinite(y)], initial=0.0)
            at_top = y == top
            if top >= 0.9 * largest > 0 and np.sum(at_top) >= LONG_RUN and _is_cut(y, top):
                saturated |= at_top
    return saturated


def _is_cut(y: Float[np.ndarray, " samples"], top: float) -> bool:
    """Whether the largest values are where a curve is cut off, rather than its smooth top."""
    starts = np.flatnonzero(np.concatenate([[True], y[1:] != y[:-1]]))
    lengths = np.diff(np.append(starts, len(y)))
    # A log that is written faster than the sensor reads repeats every value.
    longest = max(LONG_RUN, 3 * int(np.median(lengths)))
    is_long = (y[starts] == top) & (lengths >= longest)
    before, after = starts[is_long] - 1, (starts + lengths)[is_long]
    sides = np.concatenate([before[before >= 0], after[after < len(y)]])
    steep = STEEP * np.nan_to_num(_resolution(y[np.isfinite(y)]))
    return bool(np.any(top - y[sides] > steep))


def _resolution(x: Float[np.ndarray, " samples"]) -> float:
    """The step of which the differences of nearly all values are multiples; NaN if none is."""
    levels = np.unique(x[:: max(1, len(x) // MOST_LEVELS)])
    if len(levels) < 3:
        return np.nan
    size = np.max(np.abs(levels))
    difference = np.diff(levels)
    smallest = np.quantile(difference, 0.01, method="lower")
    count = np.round(difference / smallest)
    is_multiple = np.abs(difference / smallest - count) < 0.1
    # The numbers of single precision are multiples of a step as well, of no interest.
    if smallest < 1e-6 * size or np.mean(is_multiple) < 0.98:
        return np.nan
    return float(np.sum(difference[is_multiple]) / np.sum(count[is_multiple]))


def white_noise(x: Float[np.ndarray, " samples"]) -> float:
    r"""Standard deviation of white noise, of which the motion is told apart by its smoothness.

    Of white noise with the standard deviation $\sigma$, third differences have
    $\sqrt{20}\,\sigma$, and fourth ones $\sqrt{70}\,\sigma$; those of a motion that is smooth
    at the rate of the samples vanish, the fourth before the third. The median of their absolute
    values does not see the minority of samples in which a body is hit. NaN where the fourth
    differences tell that the third ones are of the motion.
    """
    if len(x) < 16:
        return np.nan
    third = np.diff(x, 3)
    # Of normal numbers half are within 0.6745 standard deviations.
    by_third = np.median(np.abs(third)) / (0.6745 * np.sqrt(20))
    by_fourth = np.median(np.abs(np.diff(third))) / (0.6745 * np.sqrt(70))
    return float(by_third) if by_fourth >= 0.8 * by_third else np.nan


def _noise_with_rounding(x: Float[np.ndarray, " samples"], step: float) -> float:
    """White noise, which is at least that of rounding to a step."""
    noise = white_noise(x)
    return noise if np.isnan(noise) else float(np.fmax(noise, step / np.sqrt(12)))


def _warnings(signal: SignalContents) -> Iterator[str]:
    if not signal.samples:
        yield "there are no samples"
        return
    if signal.missing:
        yield f"{_count(signal.missing, 'sample')} without a number (NaN)"
    if signal.gaps:
        begin, end = max(signal.gaps, key=lambda gap: gap[1] - gap[0])
        longest = f"the longest of {end - begin:.3g} s at {begin:.2f} s"
        yield f"{_count(len(signal.gaps), 'gap')}, {longest}"
    if signal.duplicates:
        yield f"{_count(signal.duplicates, 'time')} equal to the one before"
    if signal.backward:
        yield f"{_count(signal.backward, 'time')} before the one before"
    if signal.jitter * signal.rate > UNEVEN:
        yield f"intervals vary by {100 * signal.jitter * signal.rate:.0f} %"
    if signal.saturated:
        share = f"{100 * signal.saturated:.2g} % of the samples"
        yield f"saturated at {np.nanmax(np.abs([signal.lowest, signal.highest])):.5g}: {share}"
    if signal.constant:
        names = ", ".join(filter(None, signal.constant))
        yield f"constant: {names}" if names else "constant"
    for name, low, high, step in zip(
        signal.components, signal.lowest, signal.highest, signal.step, strict=True
    ):
        # Of numbers without unit many are modes and counts.
        if signal.unit not in ("", "1") and high - low < FEW_LEVELS * step:
            levels = f"{round((high - low) / step) + 1} levels, {step:.3g} {signal.unit} apart"
            yield f"{name} has only {levels}".strip()


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _lines(contents: Contents) -> Iterator[str]:
    yield f"{contents.path}: {contents.kind}"
    start = f", from {contents.start} UTC" if contents.start else ""
    if np.isfinite(contents.begin):
        yield f"{contents.end - contents.begin:.2f} s{start}"
    yield ""
    yield _row("signal", COLUMNS)
    for name, signal in contents.signals.items():
        if len(name) > NAME_WIDTH:  # names are needed as they are
            yield name
            name = ""
        yield _row(name, _cells(signal))
    by_quantity: dict[str, list[str]] = {}
    for name, signal in contents.signals.items():
        if signal.quantity:
            by_quantity.setdefault(signal.quantity.replace("_", " "), []).append(name)
    remarks = [f"{quantity}: {', '.join(names)}" for quantity, names in by_quantity.items()]
    remarks += [f"Assumed: {words}" for words in contents.assumed]
    if contents.disarmed is not None:
        parts = ", ".join(f"{begin:.2f} to {end:.2f}" for begin, end in contents.disarmed)
        remarks.append(f"disarmed: {f'{parts} s' if parts else 'never'}")
    remarks += [
        f"Warning: {name}: {'; '.join(words)}"
        for name, signal in contents.signals.items()
        if (words := signal.warnings())
    ]
    if remarks:
        yield ""
    for remark in remarks:
        yield from textwrap.wrap(
            remark, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )


def _row(name: str, cells: tuple[str, ...]) -> str:
    widths = 7, 9, 9, 6, 6, 9, 9, 7, 7
    columns = [f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True)]
    return " ".join([f"{name:{NAME_WIDTH}}", *columns])


def _cells(signal: SignalContents) -> tuple[str, ...]:
    """The cells of a signal: the widest range, the coarsest step, the highest noise."""
    numbers = [
        (signal.begin, ".2f"),
        (signal.end, ".2f"),
        (signal.rate, ".5g"),
        (np.fmin.reduce(signal.lowest, initial=np.inf), ".3g"),
        (np.fmax.reduce(signal.highest, initial=-np.inf), ".3g"),
        (np.fmax.reduce(signal.step, initial=np.nan), ".2g"),
        (np.fmax.reduce(signal.noise, initial=np.nan), ".2g"),
    ]
    texts = [f"{number:{form}}" if np.isfinite(number) else "" for number, form in numbers]
    return (str(signal.samples), *texts[:3], signal.unit, *texts[3:])


def _plain(value: Any) -> Any:
    """The value without tuples and NaN."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and np.isnan(value) else value
