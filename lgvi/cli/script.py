"""A run as a script in Python: what the command does is what the script says."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from keyword import iskeyword
from typing import Any

IMPORTS = """\
import pathlib

import jax
import numpy as np

import lgvi
import lgvi.identification as identification
import lgvi.logs
"""
LONGEST = 90  # characters of a line
PRECISION = 'jax.config.update("jax_enable_x64", True)\n'


class Script:
    """Lines of Python, which are executed as they are added.

    `--python` prints the lines: they do in Python what the command did. Values of users are in the
    lines by their `repr`, so that they are never read as code.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.names: dict[str, Any] = {}

    def start(self) -> None:
        """Import the packages, and take double precision."""
        print("lgvi: starting JAX", file=sys.stderr, flush=True)
        self.add(IMPORTS)
        self.add(PRECISION)

    def add(self, code: str) -> None:
        """Execute some lines, and keep them."""
        exec(compile(code, "<lgvi>", "exec"), self.names)
        self.lines.append(code)

    def __getitem__(self, name: str) -> Any:
        """The value of a variable of the script."""
        return self.names[name]

    def __str__(self) -> str:
        return "\n".join(line.rstrip("\n") for line in self.lines) + "\n"


def call(function: str, /, *arguments: str, **named: Any) -> str:
    """A call in code: arguments are code, and named arguments are values, or None without.

    Raises
    ------
    ValueError
        If a name is not one of Python: it would be read as code.
    """
    for name in named:
        require_name(name)
    words = [*arguments, *(f"{key}={value!r}" for key, value in named.items() if value is not None)]
    text = f"{function}({', '.join(words)})"
    if len(text) < LONGEST:
        return text
    lines = "".join(f"    {word},\n" for word in words)
    return f"{function}(\n{lines})"


def require_name(name: str) -> None:
    """Check that a name of a user is a name in Python, and no other code."""
    if not name.isidentifier() or iskeyword(name):
        raise ValueError(f"a name must have only letters, digits and _, but is {name!r}")


@contextmanager
def say(words: str) -> Iterator[None]:
    """Say on standard error what is done, and now and then how far it is."""
    from ..identification.running.progress import show_progress

    print(f"lgvi: {words}", file=sys.stderr, flush=True)
    with show_progress():
        yield
