"""What a CSV file without quotation marks says, read in the plainest way; and malformed files."""

import re

import numpy as np

HEADER = "t,trajectory,wx,wy,wz,note"
RATES = "wx", "wy", "wz"
# Of these characters and of what stands in a file that is right, malformed files are made.
ALPHABET = '0123456789.+-eE_ ,;\t\n\r"#ab\x00é\xa0１naifty'


def table(text: str) -> dict[str, np.ndarray] | None:
    """For each trajectory lines (samples, 4) of time and rates; None if the file is malformed."""
    lines = [[cell.strip() for cell in line.split(",")] for line in re.split("\r\n|\r|\n", text)]
    lines = [cells for cells in lines if any(cells)]
    header, *lines = lines or [[]]
    if not lines or any(header.count(name) != 1 for name in ("t", *RATES)):
        return None
    if header.count("trajectory") > 1:
        return None
    found: dict[str, list[list[float]]] = {}
    for cells in lines:
        if len(cells) != len(header):
            return None
        by_name = dict(zip(header, cells, strict=True))
        sample = [_number(by_name["t"])]
        if any(by_name[name] for name in RATES):
            sample += [_number(by_name[name]) for name in RATES]
        if not np.isfinite(sample).all():
            return None
        found.setdefault(by_name.get("trajectory", "0"), []).append(sample)
    result = {
        name: np.array([each for each in samples if len(each) == 4]).reshape(-1, 4)
        for name, samples in found.items()
    }
    for samples in result.values():
        times = samples[:, 0]
        if len(samples) < 2 or (np.diff(times) <= 0).any():
            return None
        if np.min(np.diff(times)) < 100 * np.finfo(float).eps * np.max(abs(times)):
            return None
    return result


def _number(cell: str) -> float:
    try:
        return np.nan if "_" in cell or not cell.isascii() else float(cell)
    except ValueError:
        return np.nan


def spoilt(rng: np.random.Generator) -> bytes:
    """A file in which up to three places are not as they were."""
    lines = [
        f"{i / 8},{name},{i},{-i / 3!r},{i * 1e-3},note"
        for i in range(rng.integers(2, 6))
        for name in "ab"[: rng.integers(1, 3)]
    ]
    text = "\n".join([HEADER, *lines, ""])
    for _ in range(rng.integers(4)):
        at, until = sorted(rng.integers(len(text) + 1, size=2))
        piece = "".join(rng.choice(list(ALPHABET), rng.integers(1, 4)))
        change = rng.integers(5)
        if change == 0:  # something more
            text = text[:at] + piece + text[at:]
        elif change == 1:  # something else
            text = text[:at] + piece + text[at + len(piece) :]
        elif change == 2:  # a few characters less
            text = text[:at] + text[at + rng.integers(1, 5) :]
        elif change == 3:  # a part twice
            text = text[:until] + text[at:until] + text[until:]
        else:  # a part less
            text = text[:at] + text[until:] if until - at < 40 else text[:until]
    data = text.encode()
    if rng.integers(20) == 0:
        at = rng.integers(len(data) + 1)
        data = data[:at] + rng.bytes(2) + data[at:]
    return data
