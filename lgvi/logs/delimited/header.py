"""The header of delimited text: names of columns, and their units."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from ...modules.units import known_unit, split_unit
from .dialect import MISSING, TIMES, Body, Dialect, Row, kind_of
from .text_files import shorten


class Header(NamedTuple):
    """The names of the columns."""

    headers: list[str]  # as in the file
    names: list[str]  # without units
    units: list[str]
    line: int | None
    facts: dict[str, str]


def read_header(body: Body, before: Sequence[Row]) -> Header:
    """The header, which is in the last lines in front of the samples."""
    dialect, text = body.dialect, body.text
    rows = [row for row in before if any(re.search(r"[^\W_]|°|%", cell) for cell in row.cells)]
    rows = [row for row in rows if any(cell.lower() not in MISSING for cell in row.cells)]
    candidates = [i for i, row in enumerate(rows) if _can_be_header(row.cells, dialect)]
    if not candidates:
        return _without_header(body, rows)
    place, units_row = candidates[-1], None
    if len(candidates) > 1 and _are_units(rows[place].cells):
        place, units_row = candidates[-2], rows[place]
    header = rows[place]
    cells = _padded(header.cells, len(dialect.kinds))
    headers = [cell or str(i) for i, cell in enumerate(cells)]
    for row in (row for row in rows if not (row.comment or row is units_row)):
        if row.line > header.line:
            _require_sample(body, row, headers)
        elif all(row.cells) and dialect.agreement(row.cells) == 1:
            raise text.error("must not be in front of the header: divide the file", row.line)
    parts = [split_unit(cell.lstrip("#% ").strip()) for cell in cells]
    names, units = [name for name, _ in parts], [unit for _, unit in parts]
    where = f"line {header.line}"
    if units_row is not None:
        pairs = zip(_padded(units_row.cells, len(units)), units, strict=True)
        units = [known_unit(cell) or unit for cell, unit in pairs]
        where += f", their units in line {units_row.line}"
    is_motive = rows[0].cells[0] == MOTIVE
    in_groups = len(set(names)) < len(names) or text.rate > 0 or is_motive
    above = _rows_above(rows, place, len(cells)) if in_groups else []
    facts = _facts(rows[: place - len(above)])
    if is_motive and len(above) > 2:
        names = _motive_names(names, above)
    else:
        names = _names_in_groups(names, above, text.rate > 0)
    text.words.append(f"The names of columns are in {where}.")
    names = [name or str(i) for i, name in enumerate(names)]
    return Header(headers, make_distinct(names), units, header.line, facts)


def _padded(cells: Sequence[str], width: int) -> list[str]:
    return [*cells, *[""] * (width - len(cells))][:width]


def _can_be_header(cells: Sequence[str], dialect: Dialect) -> bool:
    """Whether cells are words for all columns, of which one without a number may have no name."""
    lacking = len(dialect.kinds) - len(cells)
    unnamed = lacking == 1 and dialect.kinds[-1] == "missing"
    short = lacking > 0 and dialect.delimiter != " " and _are_units(cells)
    return (lacking == 0 or unnamed or short) and not dialect.has_number(cells)


def _without_header(body: Body, rows: Sequence[Row]) -> Header:
    text, width = body.text, len(body.dialect.kinds)
    names = [str(i) for i in range(width)]
    last = rows[-1] if rows and not rows[-1].comment else None
    if last is not None and body.dialect.agreement(last.cells) > 0:
        _require_sample(body, last, names)
    if last is not None and body.dialect.delimiter != " " and 1 < len(last.cells) != width:
        words = f"must have {width} names of columns, but has {len(last.cells)}"
        raise text.error(words, last.line)
    text.words.append("There is no header: columns have numbers, counted from 0, as names.")
    return Header(names, names, [""] * width, None, _facts(rows))


def _require_sample(body: Body, row: Row, headers: Sequence[str]) -> None:
    """Check that a line between the header and the samples has no words for numbers."""
    if len(row.cells) != len(headers):
        words = f"must have {len(headers)} cells as the header, but has {len(row.cells)}"
        raise body.text.error(words, row.line)
    for header, cell, kind in zip(headers, row.cells, body.dialect.kinds, strict=True):
        if kind in TIMES and kind_of(cell, body.dialect.decimal) not in (kind, "missing"):
            raise body.text.error(f"must be a {kind}, but is {shorten(cell)}", row.line, header)


def _facts(rows: Sequence[Row]) -> dict[str, str]:
    """Names with values in the lines in front of the samples."""
    facts: dict[str, str] = {}
    for row in rows:
        cells = [cell for cell in row.cells if cell]
        if row.cells[0] == MOTIVE:
            facts.update(zip(row.cells[::2], row.cells[1::2], strict=False))
        elif len(cells) == 2:
            facts[cells[0].rstrip(":= ")] = cells[1]
        elif pair := re.fullmatch(r"\W*(\w[^:=]{0,60}?)\s*[:=]\s*(\S.*)", " ".join(cells)):
            facts[pair[1]] = pair[2]
    return {name: value for name, value in facts.items() if value}


def _are_units(cells: Sequence[str]) -> bool:
    """Whether most cells that are not empty are units."""
    written = [cell for cell in cells if cell]
    return sum(bool(known_unit(cell)) for cell in written) > len(written) / 2


def _rows_above(rows: Sequence[Row], place: int, width: int) -> list[list[str]]:
    """The cells of the lines right above the names, the nearest first."""
    above = []
    for row in reversed(rows[:place]):
        adjoining = row.line == rows[place].line - len(above) - 1
        if not adjoining or row.comment or len(row.cells) < 2 or row.cells[0] == MOTIVE:
            break
        above.append(_padded(row.cells, width))
    return above


def _names_in_groups(names: list[str], above: Sequence[list[str]], always: bool) -> list[str]:
    """Names that repeat, behind the groups above them, which go on up to the next group."""
    for number, row in enumerate(above):
        if len(set(names)) == len(names) and not (always and number == 0):
            break
        joined, group = [], ""
        for cell, name in zip(row, names, strict=True):
            group = cell or group
            joined.append(f"{group}.{name}" if group else name)
        names = joined
    return names


def make_distinct(names: Sequence[str]) -> list[str]:
    """Names that differ, by numbers behind those that repeat."""
    distinct: dict[str, None] = {}
    repeats: Counter[str] = Counter()
    for name in names:
        label = name
        while label in distinct:
            repeats[name] += 1
            label = f"{name} ({repeats[name] + 1})"
        distinct[label] = None
    return list(distinct)


MOTIVE = "Format Version"  # the first cell


def _motive_names(names: Sequence[str], above: Sequence[list[str]]) -> list[str]:
    """Names from the lines type, name, ..., rotation or position, and the component."""
    what, bodies = above[0], above[-2]
    parts = zip(bodies, what, names, strict=True)
    return [
        ".".join([body, kind.lower(), *([name.lower()] if name else [])]) if kind else name
        for body, kind, name in parts
    ]
