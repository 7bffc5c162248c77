"""The table of all estimated numbers."""

from collections.abc import Callable, Iterable, Iterator
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np

from ...modules.printing import as_table
from ..model.free_leaves import Inertias, inertias_and_derivatives
from .observability import ENTRIES
from .posterior import AbstractPosterior, Spread

DIGITS = 2  # significant ones of a standard error
WIDTH = 100  # of a line, characters
HEAD = ["", "value", "std. error", "95 % interval", "unit"]


def wrap_lines(lines: Iterable[str]) -> list[str]:
    """The lines with none too long; what goes on is indented."""
    return [part for line in lines for part in wrap(line, WIDTH, subsequent_indent="    ")]


class Table(NamedTuple):
    """The estimated numbers (n,), with their 95 % intervals."""

    names: list[str]
    values: np.ndarray
    spread: Spread  # NaN for a number that is at its bound
    units: list[str]

    def __str__(self) -> str:
        cells = [HEAD, *self._cells()]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = []
        for name, *numbers, interval, unit in cells:
            right = [
                number.rjust(width) for number, width in zip(numbers, widths[1:3], strict=True)
            ]
            lines.append(
                "  ".join([name.ljust(widths[0]), *right, interval.ljust(widths[3]), unit])
            )
        return "\n".join(line.rstrip() for line in lines)

    def _cells(self) -> Iterator[list[str]]:
        for name, value, error, lower, upper, unit in zip(
            self.names, self.values, *self.spread[:3], self.units, strict=True
        ):
            written = format_alike(value, error)
            if np.isfinite(error):
                interval = f"{written(lower)} to {written(upper)}"
                yield [name, written(value), written(error), interval, unit]
            else:
                words = "not observable" if np.isinf(error) else "at its bound"
                yield [name, written(value), "" if np.isnan(error) else "inf", words, unit]

    def as_html(self) -> str:
        """The table, for notebooks."""
        return as_table(HEAD, self._cells())

    def as_arrays(self) -> dict[str, np.ndarray]:
        """The columns by name."""
        return {
            "name": np.array(self.names),
            "value": self.values,
            "standard_error": self.spread.error,
            "lower": self.spread.lower,
            "upper": self.spread.upper,
            "unit": np.array(self.units),
            "interval_freedom": self.spread.freedom,
        }


def format_alike(value: float, error: float) -> Callable[[float], str]:
    """How a value and its error are written: with the same last digit, that of the error."""
    size = max(abs(value), error)
    if not (np.isfinite(error) and error > 0 and np.isfinite(value)):
        return lambda number: f"{number:.6g}"
    decimals = DIGITS - 1 - int(np.floor(np.log10(error)))
    if 1e-4 <= size < 1e6 and decimals <= 9:
        return lambda number: f"{number:.{max(decimals, 0)}f}"
    power = int(np.floor(np.log10(size)))
    decimals = min(max(decimals + power, 0), 12)
    return lambda number: f"{number / 10.0**power:.{decimals}f}e{power:+03d}"


class Numbers(NamedTuple):
    """Numbers of a report (n,), and their Jacobian in the free leaves (n, p)."""

    names: list[str]
    values: np.ndarray
    jacobian: np.ndarray
    units: list[str]
    of_entries: np.ndarray  # (n,), whether they are entries of an inertia, or its trace


def find_numbers(posterior: AbstractPosterior) -> Numbers:
    """The numbers of the report."""
    free, numbers = posterior.free, _Numbers(posterior)
    J, derivatives = inertias_and_derivatives(posterior.parameters, free)
    values, jacobian = numbers.values(J, free.theta), numbers.jacobian(J, derivatives)
    names = numbers.names()
    moments = np.array(["principal moment" in name for name in names], bool)
    others = np.arange(len(names)) >= len(names) - len(numbers.others)
    return Numbers(names, values, jacobian, numbers.units(), ~(moments | others))


def make_table(posterior: AbstractPosterior) -> Table:
    """A row for each estimated number: entries of each inertia, its moments, and other leaves.

    If the scale of a model's inertia is not observable, the numbers are parts of its trace.
    """
    free, numbers = posterior.free, _Numbers(posterior)
    names, values, jacobian, units, _ = find_numbers(posterior)
    shape = len(free.bodies), 3, 3

    def of_leaves(theta: np.ndarray) -> np.ndarray:
        Js = np.zeros((len(theta), *shape))
        if free.bodies:
            Js = posterior.evaluate(numbers.inertias, theta).reshape(Js.shape)
        return numbers.values(Js, theta)

    spread = posterior.spread_of(values, jacobian, of_leaves)
    at_bound = np.zeros(len(values), bool)
    at_bound[len(values) - len(numbers.others) :] = posterior.information.at_bound[numbers.others]
    spread = Spread(*(np.where(at_bound, np.nan, each) for each in spread))
    return Table(names, values, spread, units)


class _Numbers:
    """The numbers of a table: of each inertia that is free, and other free leaves."""

    def __init__(self, posterior: AbstractPosterior):
        free = posterior.free
        self.free = free
        self.inertias = Inertias(tuple(body.position for body in free.bodies))
        of_model = [body.name for body in free.bodies] == [""]
        self.parts = of_model and not posterior.scale_is_observable  # of the trace
        self.others = np.flatnonzero(~free.of_body)
        self.scaled = np.isin(free.leaves, posterior.scaled)[self.others] & self.parts

    def names(self) -> list[str]:
        moments = [f"principal moment, {which}" for which in ("smallest", "middle", "largest")]
        of_inertia = [f"inertia {entry}" for entry in ENTRIES] + moments
        others = [
            f"{self.free.names[i]} / trace" if scaled else self.free.names[i]
            for i, scaled in zip(self.others, self.scaled, strict=True)
        ]
        of_bodies = [body.label(words) for body in self.free.bodies for words in of_inertia]
        return ["trace of the inertia"] * self.parts + of_bodies + others

    def units(self) -> list[str]:
        def of_part(unit: str) -> str:
            return unit and ("1" if unit == "kg m²" else f"{unit}/(kg m²)")

        units = [self.free.units[i] for i in self.others]
        others = [
            of_part(unit) if part else unit for unit, part in zip(units, self.scaled, strict=True)
        ]
        of_inertia = ["1" if self.parts else "kg m²"] * (len(ENTRIES) + 3)
        return ["kg m²"] * self.parts + of_inertia * len(self.free.bodies) + others

    def values(self, J: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The numbers (..., n) for inertias (..., bodies, 3, 3) and free leaves (..., p)."""
        found: list[np.ndarray] = []
        size = np.ones(1)
        if self.parts:
            size = np.trace(J[..., 0, :, :], axis1=-2, axis2=-1)[..., None]
            found.append(size)
        for k in range(len(self.free.bodies)):
            of_body = J[..., k, :, :]
            entries = np.stack([of_body[..., i, j] for i, j in ENTRIES.values()], axis=-1)
            for several in (entries, np.linalg.eigvalsh(of_body)):
                rounding = 1e-12 * np.max(abs(several), axis=-1, keepdims=True)
                found.append(np.where(abs(several) < rounding, 0, several) / size)
        others = theta[..., self.others]
        return np.concatenate([*found, np.where(self.scaled, others / size, others)], axis=-1)

    def jacobian(self, J: np.ndarray, derivatives: np.ndarray) -> np.ndarray:
        """The derivative of the numbers (n, p), from inertias and derivatives (bodies, 3, 3, p)."""
        found = []
        trace: Any = np.trace(J[0]) if self.parts else 1.0
        of_trace: Any = np.trace(derivatives[0]) if self.parts else 0.0

        def of_parts(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return (rows - (values / trace)[:, None] * of_trace) / trace

        if self.parts:
            found.append(of_trace[None])
        at = tuple(zip(*ENTRIES.values(), strict=True))
        for of_body, derivative in zip(J, derivatives, strict=True):
            moments, axes = np.linalg.eigh(of_body)
            found.append(of_parts(of_body[at], derivative[at]))
            found.append(of_parts(moments, np.einsum("im,ijp,jm->mp", axes, derivative, axes)))
        rows = np.eye(len(self.free.theta))[self.others]
        parts = of_parts(self.free.theta[self.others], rows)
        return np.concatenate([*found, np.where(self.scaled[:, None], parts, rows)])
