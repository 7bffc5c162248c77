"""From tables to signals."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...modules.units import standard_spelling
from ..signal import LogError, Signal
from .header import make_distinct
from .text_files import NoTableError, Options, list_columns
from .text_table import Table
from .times import Group, read_times

LATEST = 10**11  # s since 1970


class Vector(NamedTuple):
    """Columns that are one signal, or a column by itself, without components."""

    name: str
    components: tuple[str, ...]
    places: list[int]
    described: dict[str, str]  # attributes of the signal


def make_signals(
    path: Path, tables: Sequence[Table], is_file: bool, options: Options
) -> tuple[dict[str, Signal], datetime | None, list[str]]:
    """The signals of all tables, the start of the log, and how times are counted."""
    for name in options.time:
        if all(table.find(name) is None for table in tables):
            first = tables[0]
            problem = f"must have a column `{name}`, as `time` says, but has"
            raise first.body.text.error(f"{problem} {list_columns(first.names)}", first.line)
    groups, words = _groups(tables, is_file, options)
    zeros: dict[str, int] = {}  # by clock, s
    for clock, _, group in groups:
        first = group.times.first_second()
        zeros[clock] = min(zeros.get(clock, first), first)
    signals: dict[str, Signal] = {}
    used: set[str] = set()  # units that were given
    for clock, table, group in groups:
        present = group.times.present
        times = group.times.since(zeros[clock])[present]
        numbers = {i: column for i in group.places if (column := table.numbers(i)) is not None}
        if others := [table.columns[i].header for i in group.places if i not in numbers]:
            table.words.append(f"Columns of words were left out: {list_columns(others)}.")
        for vector in _vectors(table, numbers):
            values = np.stack([numbers[i][present] for i in vector.places], axis=1)
            values = values if vector.components else values[:, 0]
            name = vector.name
            if name in signals:
                name = make_distinct([*signals, f"{table.body.text.title}.{name}"])[-1]
            unit = _unit_of_signal(table, vector, name, options.units, used)
            described: dict[str, Any] = vector.described | {"unit": unit, "clock": clock}
            signals[name] = Signal(name, times, values, components=vector.components, **described)
    for name in options.units:
        if name not in used:
            problem = f"must have a column or signal `{name}`, as `units` says, but has"
            raise LogError(path, f"{problem} {list_columns(signals)}")
    if not signals:
        raise LogError(path, "must have a column of numbers besides the time")
    start = None
    for clock, zero in zeros.items():
        zones = {group.times.zone for of, _, group in groups if of == clock}
        counted = f"{zero} s of the clock of the file"
        if zones != {""} and 0 < zero < LATEST:
            date = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=zero)
            counted = f"{date:%Y-%m-%d %H:%M:%S}, {'UTC' if 'UTC' in zones else 'of no known zone'}"
            start = date if zones == {"UTC"} and len(zeros) == 1 else None
        if zero:
            words.append(f"Times of the clock `{clock}` are counted from {counted}.")
    return signals, start, words


def _groups(
    tables: Sequence[Table], is_file: bool, options: Options
) -> tuple[list[tuple[str, Table, Group]], list[str]]:
    """The clock and the columns of each time of each table, and which tables have none."""
    groups: list[tuple[str, Table, Group]] = []
    without = []
    for i, table in enumerate(tables):
        one_clock = is_file or (table.case and table.case.one_clock)
        clock = "log" if one_clock else table.name
        try:
            groups += [(clock, table, group) for group in read_times(table, options)]
        except NoTableError:
            if i + 1 == len(tables) and not groups:
                raise
            without.append(f"{table.name or table.body.text.title} has no time: left out.")
    return groups, without


def _vectors(table: Table, places: Iterable[int]) -> Iterator[Vector]:
    """The columns of numbers, of which some are vectors by the documentation of a product."""
    names = table.names
    left = [i for i in places if table.columns[i].kind != "missing" or names[i] != str(i)]
    prefix = f"{table.name}." if table.name else ""
    for pattern in table.case.patterns if table.case else ():
        vectors: dict[str, dict[str, int]] = {}
        for i in left:
            if match := re.fullmatch(pattern, f"{table.body.text.title}/{names[i]}"):
                vectors.setdefault(match["name"], {})[match["component"].lower()] = i
        for name, components in vectors.items():
            ordered = _ordered(components)
            units = {table.columns[i].unit for i in components.values()}
            if ordered and len(units) == 1 and table.case:
                described = {**table.case.describe(table, name, ordered)}
                name = described.pop("name", prefix + name)
                labels = tuple(described.pop("components", ordered))
                order = labels if set(labels) == set(ordered) else ordered
                left = [i for i in left if i not in components.values()]
                yield Vector(name, labels, [components[label] for label in order], described)
    for i in left:
        yield Vector(prefix + names[i], (), [i], {})


def _ordered(components: Iterable[str]) -> tuple[str, ...]:
    """Components of a vector in order, of a quaternion as in the file; none if some are missing."""
    names = list(components)
    if len(names) == 4 and set(names) == set("wxyz"):
        return tuple(names)
    if set(names) == set("xyz"):
        return tuple("xyz")
    numbers = sorted(names, key=lambda name: (len(name), name))
    return tuple(numbers) if numbers == [str(i) for i in range(len(names))] else ()


def _unit_of_signal(
    table: Table, vector: Vector, name: str, units: Mapping[str, str], used: set[str]
) -> str:
    """The unit that is given, or is in the header, or is documented."""
    first = table.columns[vector.places[0]]
    labels = [name]
    for i in vector.places:
        column = table.columns[i]
        labels += [column.name, column.header, f"{table.name}.{column.name}"]
    known = [label for label in labels if label in units]
    used.update(known)
    if known:
        unit = standard_spelling(units[known[0]])
        said = f" (the file says {first.unit})" if first.unit not in ("", unit) else ""
        table.words.append(f"`{name}` is in {unit}, as given{said}.")
        return unit
    return first.unit or vector.described.get("unit", "")
