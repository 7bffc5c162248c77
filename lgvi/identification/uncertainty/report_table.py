"""The rows of a report, one for each estimated number, and their table."""

from collections.abc import Callable, Iterable, Iterator
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np

from ...modules.printing import as_table
from ..model.free_leaves import inertias_and_derivatives
from .observability import ENTRIES
from .posterior import AbstractPosterior, Spread

DIGITS = 2  # significant digits of a standard error
WIDTH = 100  # characters of a line
HEAD = ["", "value", "std. error", "95 % interval", "unit"]  # of the table


def wrap_lines(lines: Iterable[str]) -> list[str]:
    """The lines, wrapped at `WIDTH`; continuations are indented."""
    return [part for line in lines for part in wrap(line, WIDTH, subsequent_indent="    ")]


class Table(NamedTuple):
    """The estimated numbers (n,), with their 95 % intervals."""

    names: list[str]
    values: np.ndarray
    spread: Spread  # NaN for a number that is at its bound
    units: list[str]

    def __str__(self) -> str:
        cells = [HEAD, *self.cells()]
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

    def cells(self) -> Iterator[list[str]]:
        """The words of each row, under `HEAD`."""
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
        return as_table(HEAD, self.cells())

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
    """The format of a value and its error: both end at the last significant digit of the error."""
    size = max(abs(value), error)
    if not (np.isfinite(error) and error > 0 and np.isfinite(value)):
        return lambda number: f"{number:.6g}"
    decimals = DIGITS - 1 - int(np.floor(np.log10(error)))
    if 1e-4 <= size < 1e6 and decimals <= 9:
        return lambda number: f"{number:.{max(decimals, 0)}f}"
    power = int(np.floor(np.log10(size)))
    decimals = min(max(decimals + power, 0), 12)
    return lambda number: f"{number / 10.0**power:.{decimals}f}e{power:+03d}"


class ReportRows(NamedTuple):
    """The numbers of a report (n,), and their Jacobian in the free leaves (n, p)."""

    names: list[str]
    values: np.ndarray
    jacobian: np.ndarray
    units: list[str]
    of_entries: np.ndarray  # (n,), whether a number is an entry of an inertia, or its trace


def find_numbers(posterior: AbstractPosterior) -> ReportRows:
    """The numbers of the report."""
    free, builder = posterior.free, _RowBuilder(posterior)
    J, derivatives = inertias_and_derivatives(posterior.parameters, free)
    values, jacobian = builder.values(J, free.theta), builder.jacobian(J, derivatives)
    names = builder.names()
    moments = np.array(["principal moment" in name for name in names], bool)
    others = np.arange(len(names)) >= len(names) - len(builder.others)
    return ReportRows(names, values, jacobian, builder.units(), ~(moments | others))


def make_table(posterior: AbstractPosterior) -> Table:
    """A row for each estimated number: entries of each inertia, its moments, and other leaves.

    If the scale of a model's inertia is not observable, the numbers are parts of its trace.
    """
    free, builder = posterior.free, _RowBuilder(posterior)
    names, values, jacobian, units, _ = find_numbers(posterior)

    def values_at(thetas: np.ndarray) -> np.ndarray:
        at_draws = [free._replace(theta=theta) for theta in thetas]
        Js = [inertias_and_derivatives(posterior.parameters, draw)[0] for draw in at_draws]
        return builder.values(np.reshape(Js, (len(thetas), len(free.bodies), 3, 3)), thetas)

    spread = posterior.spread_of(values, jacobian, values_at)
    at_bound = np.zeros(len(values), bool)
    at_bound[len(values) - len(builder.others) :] = posterior.information.at_bound[builder.others]
    spread = Spread(*(np.where(at_bound, np.nan, column) for column in spread))
    return Table(names, values, spread, units)


class _RowBuilder:
    """Makes the rows of a report: numbers of each inertia that is free, and other free leaves."""

    def __init__(self, posterior: AbstractPosterior):
        free = posterior.free
        self.free = free
        has_one_model = [body.name for body in free.bodies] == [""]
        self.over_trace = has_one_model and not posterior.scale_is_observable
        self.others = np.flatnonzero(~free.of_body)
        self.scaled = np.isin(free.leaves, posterior.scaled)[self.others] & self.over_trace

    def names(self) -> list[str]:
        moments = [f"principal moment, {which}" for which in ("smallest", "middle", "largest")]
        inertia_names = [f"inertia {entry}" for entry in ENTRIES] + moments
        others = [
            f"{self.free.names[i]} / trace" if scaled else self.free.names[i]
            for i, scaled in zip(self.others, self.scaled, strict=True)
        ]
        body_names = [body.label(words) for body in self.free.bodies for words in inertia_names]
        return ["trace of the inertia"] * self.over_trace + body_names + others

    def units(self) -> list[str]:
        def over(unit: str) -> str:
            return unit and ("1" if unit == "kg m²" else f"{unit}/(kg m²)")

        units = [self.free.units[i] for i in self.others]
        others = [
            over(unit) if scaled else unit for unit, scaled in zip(units, self.scaled, strict=True)
        ]
        inertia_units = ["1" if self.over_trace else "kg m²"] * (len(ENTRIES) + 3)
        return ["kg m²"] * self.over_trace + inertia_units * len(self.free.bodies) + others

    def values(self, J: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The numbers (..., n) for inertias (..., bodies, 3, 3) and free leaves (..., p)."""
        columns: list[np.ndarray] = []
        trace = np.ones(1)
        if self.over_trace:
            trace = np.trace(J[..., 0, :, :], axis1=-2, axis2=-1)[..., None]
            columns.append(trace)
        for k in range(len(self.free.bodies)):
            inertia = J[..., k, :, :]
            entries = np.stack([inertia[..., i, j] for i, j in ENTRIES.values()], axis=-1)
            for numbers in (entries, np.linalg.eigvalsh(inertia)):
                rounding = 1e-12 * np.max(abs(numbers), axis=-1, keepdims=True)
                columns.append(np.where(abs(numbers) < rounding, 0, numbers) / trace)
        others = theta[..., self.others]
        return np.concatenate([*columns, np.where(self.scaled, others / trace, others)], axis=-1)

    def jacobian(self, J: np.ndarray, derivatives: np.ndarray) -> np.ndarray:
        """The derivative of the numbers (n, p), from inertias and derivatives (bodies, 3, 3, p)."""
        blocks = []
        trace: Any = np.trace(J[0]) if self.over_trace else 1.0
        trace_row: Any = np.trace(derivatives[0]) if self.over_trace else 0.0

        def over_trace(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
            return (rows - (values / trace)[:, None] * trace_row) / trace

        if self.over_trace:
            blocks.append(trace_row[None])
        entries = tuple(zip(*ENTRIES.values(), strict=True))
        for inertia, derivative in zip(J, derivatives, strict=True):
            moments, axes = np.linalg.eigh(inertia)
            blocks.append(over_trace(inertia[entries], derivative[entries]))
            blocks.append(over_trace(moments, np.einsum("im,ijp,jm->mp", axes, derivative, axes)))
        rows = np.eye(len(self.free.theta))[self.others]
        parts = over_trace(self.free.theta[self.others], rows)
        return np.concatenate([*blocks, np.where(self.scaled[:, None], parts, rows)])
