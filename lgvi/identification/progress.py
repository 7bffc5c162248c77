"""A progress bar, where one is asked for."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(show: bool) -> Iterator[Callable[[float], None]]:
    """A function to call with the cost before each iteration."""
    if not show:
        yield lambda cost: None
        return
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise ImportError(
            "Argument `progress` needs the package `tqdm`: install `lgvi[identification]`."
        ) from error
    with tqdm(desc="identify", unit=" iterations") as bar:

        def report(cost: float) -> None:
            bar.set_postfix(chi_square=f"{cost:.6g}", refresh=False)
            bar.update()

        yield report
