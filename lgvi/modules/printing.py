"""How modules show themselves: few numbers as numbers, and tables in notebooks."""

from collections.abc import Iterable
from html import escape
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

MOST_SHOWN = 12  # numbers of an array


def show(module: Any) -> str:
    """A module as Equinox shows it, with the numbers of small arrays, such as `dt=0.1`."""
    return eqx.tree_pformat(jax.tree.map(_as_numbers, module), width=100)


def _as_numbers(leaf: Any) -> Any:
    if not isinstance(leaf, (jax.Array, np.ndarray)) or isinstance(leaf, Tracer):
        return leaf
    if leaf.size > MOST_SHOWN or not jnp.issubdtype(leaf.dtype, np.floating):
        return leaf
    if isinstance(leaf, jax.Array) and leaf.is_deleted():  # donated to a program
        return leaf
    digits = np.finfo(leaf.dtype).precision
    rounded = [float(f"{value:.{digits}g}") for value in np.ravel(leaf).tolist()]
    return np.reshape(np.array(rounded), leaf.shape).tolist()


def numbers_of(leaf: Any) -> str:
    """The numbers of a small array, or the shape of a large one."""
    numbers = _as_numbers(leaf)
    return f"shape {leaf.shape}" if numbers is leaf else str(numbers)


def as_table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table in HTML."""

    def line(tag: str, cells: Iterable[object]) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    lines = [line("th", head), *(line("td", row) for row in rows)]
    return f"<table>{''.join(lines)}</table>"
