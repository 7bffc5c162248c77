"""What a fit is doing, shown where somebody waits for it."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from shutil import get_terminal_size
from threading import Event, Thread
from time import monotonic
from typing import Any

import numpy as np

PATIENCE = 2.0  # s, before a bar appears that nobody asked for
INTERVAL = 0.2  # s, between two looks
FORMAT = "{desc}: {n} iterations [{elapsed}{postfix}]"  # no rate: compiling takes most of the time


class Progress:
    """What a fit says of itself; `show_progress` shows it."""

    def __init__(self) -> None:
        self.doing, self.iterations, self.cost = "compiling", 0, ""
        self.theta: np.ndarray | None = None

    def compiling(self) -> None:
        """The next evaluation compiles a program first."""
        self.doing = "compiling"

    def iteration(self, cost: float, theta: np.ndarray) -> None:
        """An iteration begins, with such a cost and such values of the free leaves."""
        self.doing, self.cost, self.theta = "fitting", f"chi_square={cost:.6g}", theta
        self.iterations += 1


@contextmanager
def show_progress(show: bool | None) -> Iterator[Progress]:
    """A bar while the context lasts: always, never, or if somebody waits for long.

    `None` shows it in a terminal or a notebook, after two seconds, and takes it away at the end.

    Raises
    ------
    ImportError
        If it is asked for, and `tqdm` is not installed.
    TypeError
        If `show` is something else.
    """
    progress = Progress()
    if not (show is None or isinstance(show, bool)):
        raise TypeError(f"Argument `progress` must be True, False or None, but is {show!r}.")
    if show is False or (show is None and not _is_watched()):
        yield progress
        return
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        if show is None:
            yield progress
            return
        raise ImportError(
            "Argument `progress` needs the package `tqdm`: install `lgvi[identification]`."
        ) from error
    start, done = monotonic(), Event()

    def made():
        # Some terminals say that they have no columns and lines, and the bar would be blank.
        size: dict[str, Any] = {}
        if not _is_notebook():
            size["ncols"], size["nrows"] = get_terminal_size()
        bar = tqdm(desc="identify, compiling", bar_format=FORMAT, leave=bool(show), **size)
        bar.start_t -= monotonic() - start
        return bar

    def watch() -> None:
        # In a thread of its own, as XLA does not come back while it compiles.
        bar = made() if show else None
        while not done.wait(INTERVAL):
            if bar is None and monotonic() - start > PATIENCE:
                bar = made()
            if bar is not None:
                bar.n, bar.desc = progress.iterations, f"identify, {progress.doing}"
                bar.set_postfix_str(progress.cost)
        if bar is not None:
            bar.n, bar.desc = progress.iterations, "identify"
            bar.set_postfix_str(progress.cost)
            bar.close()

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield progress
    finally:
        done.set()
        thread.join()


def _is_watched() -> bool:
    return _is_notebook() or (sys.stderr is not None and sys.stderr.isatty())


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules
