"""The frames of a blackbox log, which follow one another without marks between them."""

import re
from bisect import bisect_left
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from .blackbox_header import INTER, INTRA, Fields, Header
from .encodings import Bytes, Numbers, Places, decode_fields

LONGEST = 512  # bytes of a frame
WINDOW, MARGIN = 1 << 17, 2048  # bytes that are decoded at once, and beyond: more than a frame

NUMBER = rb"[\x80-\xff]{0,4}[\x00-\x7f]"  # of variable length
# Events by their number, which is their second byte: with one number, with two, of tuning, of an
# adjustment (to a number with four bytes or of variable length), and the last, to which INAV adds
# the reason. But for the last a frame follows.
EVENT = re.compile(
    rb"""E(?: (?: [\x00\x0f\x28\x32-\x34] N | [\x0e\x1e] N N | \x14 . N ..
    | \x0d [\x80-\xff] .{4} | \x0d [\x00-\x7f] N ) (?= [EIPGHS] | \Z )
    | (?P<end> \xffEnd\ of\ log [^\0]{0,40} \0 ) )""".replace(b"N", NUMBER),
    re.DOTALL | re.VERBOSE,
)

Rows = Int[np.ndarray, "frames fields"]


class Frames(NamedTuple):
    """Frames of a log, less what is predicted."""

    main: Rows  # intraframes and interframes
    is_intra: Bool[np.ndarray, " frames"]
    places: Places  # bytes where the main frames begin
    others: dict[str, tuple[Rows, Places]]
    end: int  # byte where the last frame ends
    breaks: list[int]  # bytes where no frame begins that should
    lost: int  # bytes that are no frames, before the last frame
    is_ended: bool  # by the event that ends a log


def read_frames(content: bytes, header: Header) -> Frames:
    """The frames of a log.

    Nothing but the frame after it tells that a frame is whole. So all bytes that may begin a frame
    are decoded at once, as if each did, which takes a few array operations for each field; the
    frames are the chain from the end of one to the next. Where it breaks it goes on at the next
    intraframe, without which interframes cannot be decoded.
    """
    parts = {
        kind: [(np.zeros((0, len(fields.names)), int), np.zeros(0, int))]
        for kind, fields in header.kinds.items()
    }
    begin = end = header.end
    breaks, lost, is_ended = [], 0, False
    while begin < header.stop and not is_ended:
        window, size = _window(content, begin, header.stop)
        ends, decoded = _decode_window(window, size, header.stop - begin, header.kinds)
        starts = decoded[INTRA][0]
        anchors = [*starts[ends[starts] > 0].tolist(), size]
        whole, is_frame = np.flatnonzero(ends), np.zeros(size, bool)
        steps = dict(zip(whole.tolist(), ends[whole].tolist(), strict=True))
        at = 0 if begin == end else anchors[0]  # goes on after a break
        while at < size and not is_ended:
            step = steps.get(at)
            if step:
                is_frame[at] = True
            elif event := EVENT.match(content, begin + at, header.stop):
                step, is_ended = event.end() - begin, event["end"] is not None
            if step:
                lost += begin + at - end
                at, end = step, begin + step
            else:
                breaks.append(begin + at)
                at = anchors[bisect_left(anchors, at)]
        for kind, (starts, values) in decoded.items():
            rows = is_frame[starts]
            parts[kind].append((values[:, rows].T, begin + starts[rows]))
        begin += at
    joined = {
        kind: (np.concatenate([rows for rows, _ in pairs]), np.concatenate([at for _, at in pairs]))
        for kind, pairs in parts.items()
    }
    (intra, intra_at), (inter, inter_at) = joined.pop(INTRA), joined.pop(INTER)
    places = np.concatenate([intra_at, inter_at])
    order = np.argsort(places)
    main, is_intra = np.concatenate([intra, inter])[order], order < len(intra)
    return Frames(main, is_intra, places[order], joined, end, breaks, lost, is_ended)


def _window(content: bytes, begin: int, stop: int) -> tuple[Bytes, int]:
    """Bytes with zeros after them, and how many of them may begin a frame."""
    part = np.frombuffer(content, np.uint8, min(WINDOW + MARGIN, stop - begin), begin)
    window = np.zeros(WINDOW + MARGIN, int)
    window[: len(part)] = part
    return window, min(WINDOW, stop - begin)


def _decode_window(
    window: Bytes, size: int, limit: int, kinds: Mapping[str, Fields]
) -> tuple[Places, dict[str, tuple[Places, Numbers]]]:
    """Where the frame ends that begins at each byte, or 0; and what may be frames of each kind."""
    is_kind = np.zeros(256, bool)
    is_kind[[ord(kind) for kind in (*kinds, "E")]] = True
    ends, decoded = np.zeros(size, int), {}
    for kind, fields in kinds.items():
        starts = np.flatnonzero(window[:size] == ord(kind))
        values, end = decode_fields(window, starts + 1, fields.groups)
        whole = (end - starts <= LONGEST) & (end <= limit)
        whole &= is_kind[window[end]] | (end == limit)
        ends[starts[whole]] = end[whole]
        decoded[kind] = starts, values
    # A frame is followed by a whole one, or by an event, as far as can be seen in the window. The
    # last frame before damaged bytes is left out as well, in case that they are its own.
    starts = np.flatnonzero(ends)
    follow = ends[starts]
    seen = follow < size
    is_followed = (ends[follow[seen]] > 0) | (window[follow[seen]] == ord("E"))
    ends[starts[seen][~is_followed]] = 0
    return ends, decoded
