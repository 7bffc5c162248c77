"""What a function is doing, shown where somebody waits for it."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from shutil import get_terminal_size
from threading import Event, Thread
from time import monotonic
from typing import Any, NamedTuple

import numpy as np


class BarTimes(NamedTuple):
    """When a bar is looked after."""

    patience: float = 2.0  # s, before a bar appears that nobody asked for
    interval: float = 0.2  # s, between two looks


USUAL_TIMES = BarTimes()
bar_times: ContextVar[BarTimes] = ContextVar("bar_times", default=USUAL_TIMES)
FORMAT = "{desc} [{elapsed}{postfix}]"  # no rate: compiling takes most of the time


class Progress:
    """What a function says of itself; `show_progress` shows it."""

    def __init__(self) -> None:
        self.doing: list[str] = []  # the function that was called, and what it calls
        self.compiling: str | None = None  # what
        self.iterations, self.cost = 0, ""
        self.theta: np.ndarray | None = None

    def iteration(self, cost: float, theta: np.ndarray) -> None:
        """An iteration of a fit begins, with such a cost and such values of the free leaves."""
        self.cost, self.theta = f"chi_square={cost:.6g}", theta
        self.iterations += 1

    def describe(self) -> tuple[str, str]:
        """What is done, in words, and how far it is; short, as a terminal has few columns."""
        if self.compiling is not None:
            return ", ".join([*self.doing, f"compiling {self.compiling}"]), ""
        doing = ", ".join(self.doing) or "computing"
        return f"{doing}: {self.iterations} iterations" if self.iterations else doing, self.cost


_shown: ContextVar[Progress | None] = ContextVar("_shown", default=None)


@contextmanager
def show_progress(*doing: str, show: bool | None = None) -> Iterator[Progress]:
    """A bar while the context lasts: always, never, or if somebody waits for long.

    `None` shows it in a terminal or a notebook, after two seconds, and takes it away at the end.
    Within another such context there is no second bar: the one bar says this too. It is a decorator
    of functions as well.

    Raises
    ------
    ImportError
        If it is asked for, and `tqdm` is not installed.
    TypeError
        If `show` is something else.
    """
    if not (show is None or isinstance(show, bool)):
        raise TypeError(f"Argument `progress` must be True, False or None, but is {show!r}.")
    outer = _shown.get()
    progress = Progress() if outer is None else outer
    hidden = outer is not None or show is False or (show is None and not _is_watched())
    before, calls = _shown.set(progress), len(progress.doing)
    if doing:
        progress.doing.extend(doing)
        progress.iterations, progress.cost = 0, ""  # those of a fit are over
    try:
        with nullcontext() if hidden else _bar(progress, show):
            yield progress
    finally:
        del progress.doing[calls:]
        _shown.reset(before)


@contextmanager
def show_program() -> Iterator[None]:
    """Where a program runs, which `say_compiling` tells if it is compiled first."""
    with show_progress() as progress:
        outer = progress.compiling
        try:
            yield
        finally:
            progress.compiling = outer


def say_compiling(what: str) -> None:
    """A program is traced, and will be compiled."""
    if (progress := _shown.get()) is not None:
        progress.compiling = what


@contextmanager
def _bar(progress: Progress, show: bool | None) -> Iterator[None]:
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        if show is None:
            yield
            return
        raise ImportError(
            "Argument `progress` needs the package `tqdm`: install `lgvi[identification]`."
        ) from error
    start, done, times = monotonic(), Event(), bar_times.get()

    def made():
        # Some terminals say that they have no columns and lines, and the bar would be blank.
        size: dict[str, Any] = {}
        if not _is_notebook():
            size["ncols"], size["nrows"] = get_terminal_size()
        desc, _ = progress.describe()
        bar = tqdm(desc=desc, bar_format=FORMAT, leave=bool(show), **size)
        bar.start_t -= monotonic() - start
        return bar

    def update(bar) -> None:
        bar.desc, postfix = progress.describe()
        bar.set_postfix_str(postfix)

    def watch() -> None:
        # In a thread of its own, as XLA does not come back while it compiles.
        bar = made() if show else None
        while not done.wait(times.interval):
            if bar is None and monotonic() - start > times.patience:
                bar = made()
            if bar is not None:
                update(bar)
        if bar is not None:
            if show:
                update(bar)
            bar.close()

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _is_watched() -> bool:
    return _is_notebook() or (sys.stderr is not None and sys.stderr.isatty())


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules
