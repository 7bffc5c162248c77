"""Damaged files: each is read in part, or refused in words, soon and within little memory."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

from lgvi.logs import Log, LogError

LONGEST = 2.0  # s for a file of some 10 kB
MOST_MEMORY = 100e6  # bytes more than before
STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")  # of Linux


class TooLongError(BaseException):
    """No reader may catch it."""


@contextmanager
def limited() -> Iterator[None]:
    """A limit of the time and of the memory that a reader takes."""

    def stop(number, frame):
        raise TooLongError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    begin = restart_peak()
    try:
        yield
        assert peak_memory() - begin < MOST_MEMORY
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def restart_peak() -> float:
    """Let the peak of the memory begin with what there is now, bytes."""
    if RESET.exists():
        RESET.write_text("5")
    return peak_memory()


def peak_memory() -> float:
    """The most memory that was used, bytes, without what was only asked for; 0 if not known."""
    text = STATUS.read_text() if RESET.exists() else ""
    return 1024.0 * int(text.partition("VmHWM:")[2].split()[0]) if "VmHWM:" in text else 0.0


def damaged(content: bytes, random: Random) -> bytes:
    """A file that is cut off, has other bytes, or lacks, repeats or clears a part."""
    damage = random.choice(("cut", "bytes", "bytes", "bytes", "missing", "twice", "zeros"))
    begin = random.randrange(len(content))
    end = min(begin + random.randrange(1, 400), len(content))
    if damage == "cut":
        return content[:begin]
    if damage == "bytes":
        changed = bytearray(content)
        for _ in range(random.choice((1, 3, 20))):
            changed[random.randrange(len(changed))] = random.randrange(256)
        return bytes(changed)
    part = {"missing": b"", "twice": content[begin:end] * 2, "zeros": bytes(end - begin)}
    return content[:begin] + part[damage] + content[end:]


def check_damages(
    read: Callable[[Path], Log], path: Path, file: Path | None = None, count: int = 200
) -> list[Log]:
    """Damage a file of a log in many ways; the logs that could be read in spite of it."""
    file = file or path
    content, random, logs = file.read_bytes(), Random(0), []
    for _ in range(count):
        file.write_bytes(damaged(content, random))
        with limited():
            try:
                log = read(path)
            except LogError as error:
                assert "\n" not in str(error)  # noqa: PT017
                assert str(path) in str(error)  # noqa: PT017
            else:
                assert isinstance(log, Log)
                logs.append(log)
    file.write_bytes(content)
    return logs
