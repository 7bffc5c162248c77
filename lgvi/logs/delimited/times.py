"""The times of a table: numbers in a unit, counters, dates, times of day, or a rate."""

import re
from collections.abc import Sequence
from datetime import datetime
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from ...modules.units import TIME_UNITS
from .dialect import DATE, MISSING, SAMPLED, TIME_OF_DAY
from .text_files import NoTableError, Options, list_columns
from .text_table import Column, Table, as_list

TICKS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # in a second
TIME_NAMES = {
    *("t", "ts", "time", "times", "timestamp", "timestamps", "stamp", "elapsed", "epoch"),
    *("date", "datetime", *(word for word in TIME_UNITS if len(word) > 2)),
}
TIME_COMPANIONS = {  # other words in names of times
    *("since", "start", "boot", "from", "of", "the", "unix", "utc", "gps", "posix", "system"),
    *("sys", "sample", "log", "relative", "rel", "absolute", "abs", "device", "host", "local"),
    *("and", *TIME_UNITS),
}
SINCE_1970 = {"unix", "epoch", "posix"}
PLAIN_TIMES = "t", "time"
PLAIN_STEPS = 1e-5, 1.0  # s: usual intervals of samples
LONG = 10**6  # s, from which times are counted from the first of them
DAY = 86_400 * 10**9  # ns
COUNTERS = 2**16, 2**32
USUAL_STEPS = 100  # a counter goes on after its end within so many median steps


class Times(NamedTuple):
    """Times as whole ticks and parts of a tick, which float64 holds for long clocks too."""

    whole: Int[np.ndarray, " samples"]
    part: Float[np.ndarray, " samples"]
    ticks: float  # in a second
    present: Bool[np.ndarray, " samples"]  # whether there is a time
    zone: str = ""  # of times since 1970: "UTC", or "local" if it is not known

    def first_second(self) -> int:
        """The second from which long times are counted; 0 for others."""
        whole = self.whole[self.present]
        second = int(whole[0] // self.ticks) if len(whole) else 0
        return second if abs(second) > LONG else 0

    def since(self, second: int) -> Float[np.ndarray, " samples"]:
        """Times, s, since a whole second."""
        return ((self.whole - int(second * self.ticks)) + self.part) / self.ticks


class Group(NamedTuple):
    """Columns that have one time."""

    times: Times
    places: list[int]  # of the columns


def read_times(table: Table, options: Options) -> list[Group]:
    """The times of a table, and the columns that they are of."""
    chosen = _given_times(table, options) or _recognised_times(table)
    if not chosen:
        return [_group_by_rate(table)]
    ends = [places[0] for places in chosen[1:]] + [len(table.columns)]
    begins = [0, *ends]
    groups = []
    for places, begin, end in zip(chosen, begins, ends, strict=False):
        columns = [i for i in range(begin, end) if not any(i in times for times in chosen)]
        groups.append(Group(_times(table, places, options, len(chosen) > 1), columns))
    if len(chosen) > 1:
        labels = ", ".join(f"`{table.columns[i].header}`" for places in chosen for i in places)
        table.words.append(f"Times of the sensors are the columns {labels}, taken as one clock.")
    return groups


def _given_times(table: Table, options: Options) -> list[tuple[int, ...]]:
    """The columns that the user gives, if the table has all of them."""
    places = [place for name in options.time if (place := table.find(name)) is not None]
    if len(places) < len(options.time):
        return []
    if [table.columns[i].kind for i in places] == ["date", "time of day"]:
        return [tuple(places)]
    return [(i,) for i in sorted(places)]


def _recognised_times(table: Table) -> list[tuple[int, ...]]:
    """The columns of time: by documentation, unit, dates or names, in this order."""
    columns = list(enumerate(table.columns))
    numbers = [(i, column) for i, column in columns if column.kind in ("number", "missing")]
    documented = table.case.times if table.case else {}
    for i in (table.names.index(name) for name in documented if name in table.names):
        if np.any(table.numbers(i)):
            return [(i,)]
    plain = [(i, column) for i, column in numbers if is_time(column.name)]
    if with_unit := [i for i, column in plain if _time_unit(column)]:
        return _of_one_name(table, with_unit)
    dates = [i for i, column in columns if column.kind == "date"]
    of_day = [i for i, column in columns if column.kind == "time of day"]
    if dates and (complete := [i for i in dates if _has_time_of_day(table.columns[i])]):
        return [(complete[0],)]
    if dates and of_day:
        return [(dates[0], of_day[0])]
    if of_day:
        return [(of_day[0],)]
    if plain:
        return _of_one_name(table, [i for i, _ in plain])
    sensors = [i for i, column in numbers if _is_time_of_sensor(column.name)]
    return [(i,) for i in sensors if _goes_on(table, i)]


def _of_one_name(table: Table, places: Sequence[int]) -> list[tuple[int, ...]]:
    """The first of the columns, and others of its name, which are times of further sensors."""
    first, *others = places
    others = [i for i in others if table.columns[i].header == table.columns[first].header]
    return [(first,), *((i,) for i in others if _has_numbers(table, i))]


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())


def is_time(name: str) -> bool:
    """Whether a name is that of a time, and of nothing else."""
    words = _words(name)
    return bool(TIME_NAMES & set(words)) and set(words) <= TIME_NAMES | TIME_COMPANIONS


def _is_time_of_sensor(name: str) -> bool:
    words = _words(name)
    return len(words) > 1 and bool({"t", "ts", "time", "timestamp"} & {words[0], words[-1]})


def _has_numbers(table: Table, place: int) -> bool:
    numbers = table.numbers(place)
    return numbers is not None and bool(np.isfinite(numbers).any())


def _goes_on(table: Table, place: int) -> bool:
    """Whether most numbers are larger than the one before."""
    numbers = table.numbers(place)
    steps = np.diff(numbers[np.isfinite(numbers)]) if numbers is not None else np.zeros(0)
    return len(steps) > 0 and bool(np.mean(steps > 0) > 0.5 and np.mean(steps >= 0) > 0.9)


def _has_time_of_day(column: Column) -> bool:
    date = next(filter(None, map(DATE.fullmatch, as_list(column.cells[:SAMPLED]))), None)
    return date is not None and date[2] is not None


def _time_unit(column: Column) -> str:
    """The unit of a column of time that its header tells."""
    if column.unit in TICKS:
        return column.unit
    return next((TIME_UNITS[word] for word in _words(column.name) if word in TIME_UNITS), "")


def _group_by_rate(table: Table) -> Group:
    """Times by the rate that the file declares, and by the numbers of frames, if there are some."""
    if not table.rate > 0:
        words = f"must have a column of time: write `time=` one of {list_columns(table.names)}"
        place = "" if table.line is None else f"line {table.line}"
        raise NoTableError(table.body.text.path, words, place)
    frames, within = (
        table.numbers(table.names.index(name)) if name in table.names else None
        for name in ("Frame", "Sub Frame")
    )
    count = len(table.columns[0].cells)
    if frames is None:
        table.words.append(f"Times are counted by the rate of {table.rate:g} Hz.")
        frames = np.arange(count, dtype=float)
    else:
        table.words.append(f"Times are numbers of frames by the rate of {table.rate:g} Hz.")
        if within is not None and np.nanmax(within, initial=0) > 0:
            frames = frames * (np.nanmax(within) + 1) + within
    present = np.isfinite(frames) & (abs(frames) < 2**53)
    whole = np.where(present, frames, 0).astype(np.int64)
    places = [i for i, name in enumerate(table.names) if name not in ("Frame", "Sub Frame")]
    return Group(Times(whole, np.zeros(count), table.rate, present), places)


def _times(table: Table, places: Sequence[int], options: Options, of_sensor: bool) -> Times:
    """The times in a column, or in one of dates and one of times of day."""
    label = " and ".join(f"`{table.columns[i].header}`" for i in places)
    if table.columns[places[0]].kind in ("date", "time of day"):
        times = _times_of_dates(table, places)
        table.words.append(f"Times are those of {label}.")
    else:
        times = _times_of_numbers(table, places[0], options)
    if absent := int(np.sum(~times.present)):
        if absent > len(times.whole) / 2 and (not of_sensor or absent == len(times.whole)):
            raise table.not_a("time", places[0], int(np.argmin(times.present)))
        table.words.append(f"Lines without a time in {label} were left out: {absent}.")
    return times


def _times_of_numbers(table: Table, place: int, options: Options) -> Times:
    column, numbers = table.columns[place], table.numbers(place)
    if numbers is None:
        raise table.error("must have numbers or times of ISO 8601", place)
    if np.any(wrong := abs(numbers) >= 2.0**62):
        raise table.not_a("time", place, int(np.argmax(wrong)))
    present = np.isfinite(numbers)
    whole, part = _whole_and_part(column, np.where(present, numbers, 0))
    unit = _unit_of_times(table, place, options, numbers[present])
    is_dated = (table.case and table.case.since_1970) or SINCE_1970 & set(_words(column.name))
    times = Times(whole, part, TICKS[unit], present, "UTC" if is_dated else "")
    return _unwrapped(table, column, times)


def _whole_and_part(
    column: Column, numbers: Float[np.ndarray, " samples"]
) -> tuple[Int[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    """Whole numbers and the rest, exact for all digits in the text."""
    whole = np.floor(numbers).astype(np.int64)
    part = numbers - whole
    if np.any(whole > (LONG if part.any() else 2**53)):
        cells = as_list(column.cells)
        for i in np.flatnonzero(whole > 0):
            digits, _, fraction = cells[i].partition(".")
            if digits.isdecimal() and (fraction or "0").isdecimal():
                whole[i], part[i] = int(digits), float(f"0.{fraction}0")
    return whole, part


def _unit_of_times(
    table: Table, place: int, options: Options, numbers: Float[np.ndarray, " samples"]
) -> str:
    """The unit of a column of time."""
    column = table.columns[place]
    documented = table.case.times.get(column.name, "") if table.case else ""
    declared = _time_unit(column) or documented
    if unit := options.time_unit or declared:
        said = ", as given" if options.time_unit else ""
        said += f" (the file says {declared})" if declared not in ("", unit) else ""
        table.words.append(f"Times are `{column.header}`, in {unit}{said}.")
        return unit
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    low, high = PLAIN_STEPS
    usual = len(steps) > 0 and np.any(numbers % 1) and low <= np.median(steps) <= high
    name = column.name.lower().partition(" (")[0]  # without a number of a repeated name
    if usual and name in PLAIN_TIMES and not column.unit:
        table.words.append(f"Times are `{column.header}`, assumed to be in s, by their steps.")
        return "s"
    first = ", ".join(f"{number:.10g}" for number in numbers[:3])
    allowed = ", ".join(map(repr, TICKS))
    said = f"has {column.unit!r}" if column.unit else "the file does not tell"
    words = f"must have a unit of time, but {said}: write `time_unit=` one of {allowed}"
    raise table.error(f"{words}; the first are {first}", place)


def _unwrapped(table: Table, column: Column, times: Times) -> Times:
    """Times of a counter that begins again after its largest value, as if it went on."""
    numbers = (times.whole + times.part)[times.present]
    steps = np.diff(numbers)
    if not (steps < 0).any() or not (steps > 0).any():
        return times
    usual = USUAL_STEPS * np.median(steps[steps > 0])
    in_microseconds = 2**32 / 10**6 * times.ticks  # of a counter of microseconds
    for length in (*COUNTERS, in_microseconds):
        late = min(usual, length / 8)
        back = steps[steps < -late]
        if len(back) and np.ptp(numbers) < length and np.all(back + length <= late):
            whole, part = np.divmod(_laps(numbers, times.present, length, late) * length, 1)
            words = f"is a counter that begins again after {length:.10g}: its times go on"
            table.words.append(f"`{column.header}` {words}.")
            whole = times.whole + whole.astype(np.int64)
            return times._replace(whole=whole, part=times.part + part)
    return times


def _laps(
    numbers: Shaped[np.ndarray, " times"],
    present: Bool[np.ndarray, " samples"],
    length: float,
    late: float,
) -> Int[np.ndarray, " samples"]:
    """How often a clock has begun again; a sample may be so late that it is of the lap before."""
    steps = np.diff(numbers)
    laps = np.zeros(len(present), np.int64)
    turns = (steps < -length / 2) * 1 - (steps > length - late)
    laps[np.flatnonzero(present)[1:]] = np.cumsum(turns)
    return laps


def _times_of_dates(table: Table, places: Sequence[int]) -> Times:
    """Times, ns, of dates, or of times of day, which go on at midnight."""
    whole, present, zoned = np.array(0), np.array(True), np.array(False)
    for place in places:
        kind = table.columns[place].kind
        read = _read_date if kind == "date" else _read_time_of_day
        cells = as_list(table.columns[place].cells)
        nanoseconds, there = np.zeros(len(cells), np.int64), np.zeros(len(cells), bool)
        with_zone = there.copy()
        for i, cell in enumerate(cells):
            if cell.lower() not in MISSING:
                try:
                    nanoseconds[i], with_zone[i] = read(cell)
                except ValueError:
                    raise table.not_a(kind, place, i) from None
                there[i] = True
        if with_zone.any() and (lacking := there & ~with_zone).any():
            kind = "date with a time zone, as other dates"
            raise table.not_a(kind, place, int(np.argmax(lacking)))
        whole, present, zoned = whole + nanoseconds, present & there, zoned | with_zone
    has_date = table.columns[places[0]].kind == "date"
    if not has_date and (days := _laps(whole[present], present, DAY, DAY / 100)).any():
        table.words.append("Times of day go on after midnight.")
        whole = whole + days * DAY
    zone = "UTC" if zoned.any() else "local" if has_date else ""
    return Times(whole, np.zeros(len(whole)), 10**9, present, zone)


def _read_date(cell: str) -> tuple[int, bool]:
    """Nanoseconds since 1970, and whether the date has a time zone."""
    if not (date := DATE.fullmatch(cell)):
        raise ValueError
    day, minutes, seconds, fraction, zone = date.groups()
    offset = (zone or "").removeprefix("UTC").removeprefix("GMT").strip() or "Z"
    of_day = f"{minutes or '00:00'}:{seconds or '00'}{offset}"
    moment = datetime.fromisoformat(f"{day.replace('/', '-')}T{of_day}")
    return int(moment.timestamp()) * 10**9 + int(f"{fraction or '':0<9}"), zone is not None


def _read_time_of_day(cell: str) -> tuple[int, bool]:
    """Nanoseconds since midnight."""
    if not (time := TIME_OF_DAY.fullmatch(cell)):
        raise ValueError
    hours, minutes, seconds, fraction = time.groups()
    whole = (int(hours) * 60 + int(minutes)) * 60 + int(seconds)
    return whole * 10**9 + int(f"{fraction or '':0<9}"), False
