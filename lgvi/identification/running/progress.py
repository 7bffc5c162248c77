"""The progress of functions, shown where somebody waits."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from shutil import get_terminal_size
from threading import Event, Thread
from time import monotonic
from typing import Any, NamedTuple

import numpy as np


class Times(NamedTuple):
    """The times of what is shown."""

    patience: float = 2.0  # s, before a bar appears that nobody asked for
    interval: float = 0.2  # s, between two updates of a bar
    line: float = 10.0  # s, between two lines where there is no bar


USUAL_TIMES = Times()
times: ContextVar[Times] = ContextVar("times", default=USUAL_TIMES)
FORMAT = "{desc} [{elapsed}{postfix}]"  # no rate: compiling takes most of the time


class Progress:
    """The progress of a function, which `show_progress` shows."""

    def __init__(self) -> None:
        self.doing: list[str] = []  # the function that was called, and the functions called there
        self.compiling: str | None = None  # a program, in words
        self.iterations, self.cost = 0, ""
        self.theta: np.ndarray | None = None

    def iteration(self, cost: float, theta: np.ndarray) -> None:
        """Note that an iteration of a fit begins, with a cost and values of the free leaves."""
        self.cost, self.theta = f"chi_square={cost:.6g}", theta
        self.iterations += 1

    def describe(self) -> tuple[str, str]:
        """The work and the progress in words; short, as a terminal has few columns."""
        if self.compiling is not None:
            return ", ".join([*self.doing, f"compiling {self.compiling}"]), ""
        doing = ", ".join(self.doing) or "computing"
        return f"{doing}: {self.iterations} iterations" if self.iterations else doing, self.cost


_shown: ContextVar[Progress | None] = ContextVar("_shown", default=None)


@contextmanager
def show_progress(*doing: str, show: bool | None = None) -> Iterator[Progress]:
    """A bar while the context lasts: always, never, or if somebody waits for long.

    `None` shows the bar in a terminal or a notebook, after two seconds, and removes it at the end;
    elsewhere it writes a line on standard error every ten seconds. Within another such context
    there is no second bar: the first bar shows both. The context is also a decorator of functions.

    Raises
    ------
    ImportError
        If `show` is True, and `tqdm` is not installed.
    TypeError
        If `show` is something else.
    """
    if not (show is None or isinstance(show, bool)):
        raise TypeError(f"Argument `progress` must be True, False or None, but is {show!r}.")
    outer = _shown.get()
    progress = Progress() if outer is None else outer
    if outer is not None or show is False or (show is None and sys.stderr is None):
        shown = nullcontext()
    elif show or _is_watched():
        shown = _bar(progress, show)
    else:
        shown = _lines(progress)
    before, calls = _shown.set(progress), len(progress.doing)
    if doing:
        progress.doing.extend(doing)
        progress.iterations, progress.cost = 0, ""  # of a fit that has ended
    try:
        with shown:
            yield progress
    finally:
        del progress.doing[calls:]
        _shown.reset(before)


@contextmanager
def show_program() -> Iterator[None]:
    """A context in which a program runs; `say_compiling` notes if it is compiled first."""
    with show_progress() as progress:
        outer = progress.compiling
        try:
            yield
        finally:
            progress.compiling = outer


def say_compiling(what: str) -> None:
    """Note that a program is traced, and will be compiled."""
    if (progress := _shown.get()) is not None:
        progress.compiling = what


@contextmanager
def _bar(progress: Progress, show: bool | None) -> Iterator[None]:
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        if show is None:
            with _lines(progress):
                yield
            return
        raise ImportError(
            "Argument `progress` needs the package `tqdm`: install `lgvi[identification]`."
        ) from error
    start, done, waits = monotonic(), Event(), times.get()

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
        bar = made() if show else None
        while not done.wait(waits.interval):
            if bar is None and monotonic() - start > waits.patience:
                bar = made()
            if bar is not None:
                update(bar)
        if bar is not None:
            if show:
                update(bar)
            bar.close()

    with _thread(watch, done):
        yield


@contextmanager
def _lines(progress: Progress) -> Iterator[None]:
    """A line on standard error now and then."""
    start, done, wait = monotonic(), Event(), times.get().line

    def watch() -> None:
        while not done.wait(wait):
            doing = ", ".join(filter(None, progress.describe()))
            print(f"lgvi: ... {monotonic() - start:.0f} s, {doing}", file=sys.stderr, flush=True)

    with _thread(watch, done):
        yield


@contextmanager
def _thread(watch: Callable[[], None], done: Event) -> Iterator[None]:
    """A function in a thread of its own while the context lasts, as XLA keeps this one."""
    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _is_watched() -> bool:
    return _is_notebook() or sys.stderr.isatty()


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules
