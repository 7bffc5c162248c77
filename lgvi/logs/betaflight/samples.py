"""From the frames of a blackbox log to samples: what is predicted is added, times are checked.

An intraframe and the interframes up to the next one are a group.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..signal import LogError
from .blackbox_header import (
    FIRST_MOTOR,
    GPS,
    HOME,
    HOME_POSITION,
    INTER,
    INTRA,
    MAIN_TIME,
    WEIGHTS,
    Header,
)
from .encodings import Places
from .frames import Frames, Rows

WRAP = 2**32  # the clock of the flight computer, and numbers, have 32 bits
LONGEST_INTERVAL = 1_000_000  # us from one frame to the next in a group
LONGEST_GROUP = 2048  # frames: an intraframe is written every 32 ms
SLACK, DRIFT = 100_000, 0.2  # us, and part of the time, by which a group may be early or late


class Table(NamedTuple):
    """Values of the fields of one kind of frames, with their times, s."""

    names: Sequence[str]
    times: Float[np.ndarray, " frames"]
    rows: Int[np.ndarray, "frames fields"] | Float[np.ndarray, "frames fields"]


def make_samples(path: Path, header: Header, frames: Frames) -> tuple[list[Table], list[str]]:
    """Samples of main frames, and of others; and what is damaged, in words.

    Frames whose times cannot be are left out.
    """
    begins = np.flatnonzero(frames.is_intra)
    if not len(begins):
        raise LogError(path, "must have frames, but has none", f"byte {header.end}")
    # Interframes before the first intraframe cannot be decoded.
    main, places = frames.main[begins[0] :], frames.places[begins[0] :]
    begins = begins - begins[0]
    lengths = np.diff(begins, append=len(main))
    _add_predictions(header, main, begins, lengths)
    times, kept = _make_times(header, main, begins, lengths)
    left, size = len(main) - int(np.sum(kept)), frames.end - header.end
    if 2 * left > len(main) or 2 * frames.lost > size:
        words = f"is damaged: of {size} bytes {frames.lost} are no frames, and of {len(main)} "
        raise LogError(path, f"{words}frames {left} have times that cannot be")
    seconds = (times - times[kept][0]) / 1e6
    tables = [Table(header.kinds[INTRA].names, seconds[kept], main[kept])]
    others = {}
    for kind, (rows, at) in frames.others.items():  # they follow a main frame
        before = np.maximum(np.searchsorted(places, at) - 1, 0)
        chosen = kept[before]
        others[kind] = seconds[before[chosen]], rows[chosen], at[chosen]
    homes = others.pop(HOME, None)
    for kind, (times, rows, at) in others.items():
        if kind == GPS:
            times, rows = _complete_positions(header.kinds[GPS].predictors, times, rows, at, homes)
        tables.append(Table(header.kinds[kind].names, times, rows))
    return tables, [*header.damage, *_losses(header, frames, left)]


def _add_predictions(header: Header, main: Rows, begins: Places, lengths: Places) -> None:
    intra, inter = header.kinds[INTRA], header.kinds[INTER]
    lowest = np.where(intra.is_signed, -WRAP // 2, 0)

    def add(rows: Int[np.ndarray, " rows"], predicted: Any, predictors: list[int]) -> None:
        values = main[rows] + predicted
        values += [header.references.get(predictor, 0) for predictor in predictors]
        from_first = np.equal(predictors, FIRST_MOTOR)
        if from_first.any():
            values[:, from_first] += values[:, [header.column("motor[0]")]]
        main[rows] = (values - lowest) % WRAP + lowest  # in 32 bits

    add(begins, 0, intra.predictors)
    weights = np.array([WEIGHTS.get(predictor, (0, 0)) for predictor in inter.predictors]).T
    # Frames beyond the longest group keep times that cannot be.
    for k in range(1, min(max(lengths), LONGEST_GROUP)):
        first = begins[lengths > k]
        rows = first + k
        before = main[np.maximum(rows - 2, first)]
        predicted = (weights[0] * main[rows - 1] + weights[1] * before).astype(int)  # towards zero
        add(rows, predicted, inter.predictors)


def _make_times(
    header: Header, main: Rows, begins: Places, lengths: Places
) -> tuple[Int[np.ndarray, " frames"], Bool[np.ndarray, " frames"]]:
    """Times of main frames, us, without the wraps of the clock; and which can be."""
    group = np.repeat(np.arange(len(begins)), lengths)
    first = begins[group]
    clock = main[:, header.column("time")]
    interval = np.diff(clock, prepend=clock[:1]) % WRAP
    interval[begins] = 0
    is_late = np.cumsum(interval > LONGEST_INTERVAL)
    elapsed = np.cumsum(np.minimum(interval, LONGEST_INTERVAL))
    starts, kept = _order_groups(clock[begins], main[begins, header.column("loopIteration")])
    ends = np.full(len(starts), np.iinfo(int).max)
    ends[np.flatnonzero(kept)[:-1]] = starts[kept][1:]
    times = starts[group] + elapsed - elapsed[first]
    return times, kept[group] & (is_late == is_late[first]) & (times <= ends[group])


def _order_groups(
    clock: Int[np.ndarray, " groups"], loop: Int[np.ndarray, " groups"]
) -> tuple[Int[np.ndarray, " groups"], Bool[np.ndarray, " groups"]]:
    """When groups begin, us, without the wraps of the clock; and which belong to the log.

    The clock and the number of the main loop advance together, also while logging is paused; in
    bytes that only look like an intraframe they do not.
    """
    starts, kept = clock.copy(), np.ones(len(clock), bool)
    passed, loops = np.diff(clock), np.diff(loop)
    ahead = loops > 0
    if not ahead.any():
        kept[1:] = False
        return starts, kept
    period = float(np.median(passed[ahead] % WRAP / loops[ahead]))

    def follows(passed: Any, loops: Any) -> Any:
        expected = period * loops
        error = (passed - expected + WRAP / 2) % WRAP - WRAP / 2
        tolerance = SLACK + DRIFT * expected
        return (loops > 0) & (abs(error) <= tolerance) & (error >= -expected)

    is_next = follows(passed, loops)
    if not np.all(is_next):  # take the longest run, and what fits to it before and after
        bounds = np.concatenate([[-1], np.flatnonzero(~is_next), [len(is_next)]])
        start = int(bounds[np.argmax(np.diff(bounds))]) + 1
        kept[:] = np.arange(len(kept)) == start
        for later in (range(start + 1, len(kept)), range(start - 1, -1, -1)):
            last = start
            for i in later:
                one, two = sorted((last, i))
                if follows(clock[two] - clock[one], loop[two] - loop[one]):
                    kept[i], last = True, i
    passed, loops = np.diff(clock[kept]), np.diff(loop[kept])
    passed += np.round((period * loops - passed) / WRAP).astype(int) * WRAP
    starts[kept] = clock[kept][0] + np.append(0, np.cumsum(passed))
    return starts, kept


def _complete_positions(
    predictors: list[int],
    times: Float[np.ndarray, " frames"],
    rows: Rows,
    at: Places,
    homes: tuple[Any, Rows, Places] | None,
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, "frames fields"]]:
    """Times and values of positions, which are told from those of a main frame and of home."""
    rows = rows.astype(float)
    _, home_rows, home_at = homes or (0, np.zeros((0, 0)), np.zeros(0))
    origin = np.full((len(rows), home_rows.shape[1]), np.nan)
    last = np.searchsorted(home_at, at) - 1  # home before the position
    origin[last >= 0] = home_rows[last[last >= 0]]
    origins = iter(origin.T)
    for column, predictor in enumerate(predictors):
        if predictor == MAIN_TIME:
            delay = rows[:, column]
            times = times + np.where(delay < LONGEST_INTERVAL, delay, 0) / 1e6
        elif predictor == HOME_POSITION:
            rows[:, column] += next(origins, np.nan)
    return times, rows


def _losses(header: Header, frames: Frames, left: int) -> Iterator[str]:
    breaks = [place for place in frames.breaks if place < frames.end]
    if breaks:
        yield (
            f"The log is damaged in {len(breaks)} places, the first at byte {breaks[0]}: "
            f"{frames.lost} bytes up to the next intraframes were left out."
        )
    if left:
        yield f"{left} frames were left out, as their times cannot be."
    if not frames.is_ended:
        rest = header.stop - frames.end
        after = f", and {rest} bytes that are no frames follow" if rest else ""
        yield f"The log stops at byte {frames.end} without the event that ends it{after}."
