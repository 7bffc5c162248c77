"""How the frames of a blackbox log encode numbers.

A decoder decodes many frames at once. It takes the bytes, the places where the numbers of the
frames begin, and how many fields are packed together; it returns the numbers and where they end.
"""

from collections.abc import Sequence
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Int

Bytes = Int[np.ndarray, " bytes"]
Places = Int[np.ndarray, " frames"]
Numbers = Int[np.ndarray, "fields frames"]

# Of three values by the first two bits: where they are in the first three bytes (bits to the right,
# bits), and how many bytes they take.
PACKED = ((20, 2), (18, 2), (16, 2)), 1
EVEN = PACKED, (((16, 4), (12, 4), (8, 4)), 2), (((16, 6), (8, 6), (0, 6)), 3)
UNEVEN = PACKED, (((17, 5), (12, 5), (8, 4)), 2), (((14, 8), (7, 7), (0, 7)), 3)
HALF_BYTES = np.array([0, 1, 2, 4])  # of one of four values, by two bits of the first byte


def group_fields(encodings: Sequence[int]) -> list[tuple[int, int]]:
    """Fields that are packed together: encoding and number; none if an encoding is not known."""
    groups = []
    for encoding, run in groupby(encodings):
        count, (most, _) = len(list(run)), DECODERS.get(encoding, (0, None))
        if not most or (encoding != BYTE_OF_EIGHT and count % most):
            return []
        groups += [(encoding, min(most, count - first)) for first in range(0, count, most)]
    return groups


def decode_fields(
    content: Bytes, at: Places, groups: Sequence[tuple[int, int]]
) -> tuple[Numbers, Places]:
    """The numbers of frames, and where the frames end."""
    parts = []
    for encoding, count in groups:
        numbers, at = DECODERS[encoding][1](content, at, count)
        parts.append(numbers)
    return np.concatenate(parts), at


def _decode_unsigned(content: Bytes, at: Places, count: int = 1) -> tuple[Numbers, Places]:
    """Seven bits in a byte, the lowest first; the eighth says that more follow."""
    value, at = content[at], at + 1
    more = np.flatnonzero(value > 127)
    for shift in (7, 14, 21, 28):
        byte = content[at[more]]
        value[more] += (byte - 1) << shift  # and without the eighth bit of the byte before
        at[more] += 1
        more = more[byte > 127]
        if not len(more):
            break
    return value[None], at


def _decode_signed(content: Bytes, at: Places, count: int = 1) -> tuple[Numbers, Places]:
    """Zigzag: 0, -1, 1, -2, ..."""
    value, at = _decode_unsigned(content, at)
    return (value >> 1) ^ -(value & 1), at


def _decode_negative(content: Bytes, at: Places, count: int) -> tuple[Numbers, Places]:
    value, at = _decode_unsigned(content, at)
    return -_sign(value, 14), at


def _decode_nothing(content: Bytes, at: Places, count: int) -> tuple[Numbers, Places]:
    return np.zeros((1, len(at)), int), at


def _decode_eight(content: Bytes, at: Places, count: int) -> tuple[Numbers, Places]:
    """A byte whose bits say which fields are not zero, and these; a single field is bare."""
    if count == 1:
        return _decode_signed(content, at)
    tag, at = content[at], at + 1
    values = np.zeros((count, len(at)), int)
    some = np.flatnonzero(tag)
    for i in range(count):
        present = some[tag[some] >> i & 1 > 0]
        if len(present):
            values[i, present], at[present] = _decode_signed(content, at[present])
    return values, at


def _decode_three(packing: tuple, content: Bytes, at: Places, count: int) -> tuple[Numbers, Places]:
    """Two bits, and three values of few bits; or a size for each, and so many bytes."""
    tag, at = content[at], at.copy()
    bits = tag << 16 | content[at + 1] << 8 | content[at + 2]
    values = np.empty((3, len(at)), int)
    for selector, (places, size) in enumerate(packing):
        chosen = np.flatnonzero(tag >> 6 == selector)
        for value, (shift, width) in zip(values, places, strict=True):
            value[chosen] = _sign(bits[chosen] >> shift, width)
        at[chosen] += size
    chosen = np.flatnonzero(tag >> 6 == 3)
    at[chosen] += 1
    for i, value in enumerate(values):
        size, begin = (tag[chosen] >> 2 * i & 3) + 1, at[chosen]
        number = sum(content[begin + k] << 8 * k for k in range(4))
        value[chosen] = _sign(number, 8 * size)
        at[chosen] += size
    return values, at


def _decode_four(content: Bytes, at: Places, count: int) -> tuple[Numbers, Places]:
    """A byte that says how many bits each value has, and the values, half bytes in a row."""
    tag, place = content[at], 2 * (at + 1)
    values = np.zeros((4, len(at)), int)
    some = np.flatnonzero(tag)
    for i in range(4):
        size, begin = HALF_BYTES[tag[some] >> 2 * i & 3], place[some]
        byte = begin >> 1
        bits = content[byte] << 16 | content[byte + 1] << 8 | content[byte + 2]
        values[i, some] = _sign(bits >> (24 - 4 * (begin & 1) - 4 * size), 4 * size)
        place[some] += size
    return values, (place + 1) >> 1


def _sign(number: Any, bits: Any) -> Any:
    """The lowest bits of a number, as a signed one."""
    half = (1 << bits) >> 1
    return ((number & ((1 << bits) - 1)) ^ half) - half


# By the number of the encoding: how many fields it packs, at most, and the decoder.
BYTE_OF_EIGHT = 6
DECODERS: dict[int, tuple[int, Any]] = {
    0: (1, _decode_signed),
    1: (1, _decode_unsigned),
    3: (1, _decode_negative),
    BYTE_OF_EIGHT: (8, _decode_eight),
    7: (3, partial(_decode_three, EVEN)),
    8: (4, _decode_four),
    9: (1, _decode_nothing),
    10: (3, partial(_decode_three, UNEVEN)),
}
