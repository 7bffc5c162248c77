"""What a fit is doing, shown where somebody waits for it."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from time import monotonic

PATIENCE = 2.0  # s, before a bar appears that nobody asked for
INTERVAL = 0.2  # s, between two looks


class Progress:
    """What a fit says of itself; `show_progress` shows it."""

    def __init__(self) -> None:
        self.doing, self.iterations, self.cost = "compiling", 0, ""

    def compiling(self) -> None:
        """The next evaluation compiles a program first."""
        self.doing = "compiling"

    def iteration(self, cost: float) -> None:
        """An iteration begins, with such a cost."""
        self.doing, self.cost = "fitting", f"chi_square={cost:.6g}"
        self.iterations += 1


@contextmanager
def show_progress(show: bool | None) -> Iterator[Progress]:
    """A bar while the context lasts: always, never, or if somebody waits for long.

    `None` shows it in a terminal or a notebook, after two seconds.

    Raises
    ------
    ImportError
        If it is asked for, and `tqdm` is not installed.
    """
    progress = Progress()
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

    def watch() -> None:
        # In a thread of its own, as XLA does not come back while it compiles.
        bar = tqdm(unit=" iterations") if show else None
        while not done.wait(INTERVAL):
            if bar is None and monotonic() - start > PATIENCE:
                bar = tqdm(unit=" iterations")
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
    return "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty())
