"""The header of a blackbox log: lines of text that say how its frames are encoded."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, NoReturn

from ..signal import LogError
from .encodings import group_fields

LINE = re.compile(rb"H ([ -9;-~]{1,80}):([^\n]{0,4000})\n")
LARGEST_HEADER, LONGEST_GAP = 65536, 400  # bytes, also of a damaged line
MOST_FIELDS = 256  # of a frame

INTRA, INTER, GPS, HOME, SLOW = "IPGHS"
FIRST_MOTOR, HOME_POSITION, MAIN_TIME = 5, 7, 10
# Weights of the last frame and of the one before, for predictors that need them.
WEIGHTS = {1: (1, 0), 2: (2, -1), 3: (0.5, 0.5), 6: (1, 0)}
# Lines of the header whose first number predictors take; others are constant.
REFERENCES = {4: "minthrottle", 9: "vbatref", 11: "motorOutput"}
CONSTANTS = {6: 1, 8: 1500}
PREDICTORS = {
    INTRA: {0, FIRST_MOTOR, 8, *REFERENCES},
    INTER: {0, FIRST_MOTOR, *WEIGHTS, *CONSTANTS, *REFERENCES},
    GPS: {0, HOME_POSITION, MAIN_TIME},
    HOME: {0},
    SLOW: {0, 1},  # INAV declares the frame before, but writes numbers as they are
}


class Fields(NamedTuple):
    """The fields of one kind of frames."""

    names: list[str]
    predictors: list[int]
    groups: list[tuple[int, int]]  # encoding, number of fields that are packed together
    is_signed: list[bool]


class Header(NamedTuple):
    """What a log says of itself before the frames."""

    lines: Mapping[str, str]
    kinds: Mapping[str, Fields]
    references: Mapping[int, int]  # constants that predictors take
    end: int  # byte where the frames begin
    stop: int  # byte where the log ends
    damage: list[str]  # in words

    def column(self, name: str) -> int:
        """The number of a field of the main frames."""
        return self.kinds[INTRA].names.index(name)


Refuse = Callable[[str, str], NoReturn]


def read_header(path: Path, content: bytes, begin: int, stop: int) -> Header:
    """The header of the log that is in a part of a file."""

    def refuse(words: str, line: str) -> NoReturn:
        raise LogError(path, words, f"byte {begin}, line `{line}` of the header")

    lines, end, damage = _read_lines(content, begin, stop)
    if lines.get("Data version") != "2":
        refuse(f"must be 2, but is {lines.get('Data version', 'not there')}", "Data version")
    others = [kind for kind in (GPS, HOME, SLOW) if f"Field {kind} name" in lines]
    kinds = {kind: _read_fields(lines, kind, refuse) for kind in (INTRA, INTER, *others)}
    main, used = kinds[INTRA], {*kinds[INTRA].predictors, *kinds[INTER].predictors}
    for name in ("loopIteration", "time", *(["motor[0]"] if FIRST_MOTOR in used else [])):
        if name not in main.names:
            refuse(f"must have `{name}`, but has not", f"Field {INTRA} name")
    references = {
        predictor: _read_numbers(lines, line, refuse)[0]
        for predictor, line in REFERENCES.items()
        if predictor in used
    }
    stop = begin + len(content[begin:stop].rstrip(b"\xff"))  # erased flash memory
    return Header(lines, kinds, CONSTANTS | references, end, stop, damage)


def _read_lines(content: bytes, begin: int, stop: int) -> tuple[dict[str, str], int, list[str]]:
    """The lines by name, where they end, and which are damaged, in words."""
    lines, end, damage = {}, begin, []
    for line in LINE.finditer(content, begin, min(begin + LARGEST_HEADER, stop)):
        if line.start() - end > LONGEST_GAP:
            break
        if line.start() > end:
            damage.append(f"A line of the header is damaged at byte {end}.")
        name, value = (text.decode(errors="replace") for text in line.groups())
        lines[name], end = value.strip(), line.end()
    return lines, end, damage


def _read_fields(lines: Mapping[str, str], kind: str, refuse: Refuse) -> Fields:
    """The fields of a kind of frames; names and signs are told once for both main frames."""
    shared = INTRA if kind == INTER else kind
    names = lines.get(f"Field {shared} name", "").split(",")
    table = {}
    for key in ("predictor", "encoding"):
        line = f"Field {kind} {key}"
        table[key] = _read_numbers(lines, line, refuse)
        if not len(table[key]) == len(names) <= MOST_FIELDS:
            words = f"must have a number for each of {len(names)} fields (at most {MOST_FIELDS})"
            refuse(f"{words}, but has {len(table[key])}", line)
    if strange := {*table["predictor"]} - PREDICTORS[kind]:
        refuse(f"has the predictor {min(strange)}, not known here", f"Field {kind} predictor")
    groups = group_fields(table["encoding"])
    if not groups:
        refuse("has encodings that are not known here", f"Field {kind} encoding")
    signs = lines.get(f"Field {shared} signed", "").split(",")
    signs += ["1"] * len(names)  # if the line is damaged
    is_signed = [sign != "0" for sign in signs[: len(names)]]
    return Fields(names, table["predictor"], groups, is_signed)


def _read_numbers(lines: Mapping[str, str], line: str, refuse: Refuse) -> list[int]:
    if line not in lines:
        refuse("must be there, but is not", line)
    texts = lines[line].split(",")
    if not all(re.fullmatch(r"-?\d{1,9}", text) for text in texts):
        refuse(f"must have whole numbers, but has {lines[line][:80]!r}", line)
    return [int(text) for text in texts]
