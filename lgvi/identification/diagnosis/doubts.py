"""What speaks against a model after a fit: suspects, and trajectories that differ."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from ..fitted_part import FittedPart
from ..report import Numbers
from .score_test import Scored

CHANCE = 1e-3  # probability at most, in all, of what is not taken for chance
NOTED = 0.05  # the same, of suspects that a report names
MOVED = 1.0  # standard errors by which a suspect must move a number to matter
ALIKE = 1e-6  # relative difference of gains between which the data do not decide


class Suspect(NamedTuple):
    """What the model may leave out, and what freeing it would do, by a score test.

    Attributes
    ----------
    names
        The leaf, or what acts on the body; several, if nothing tells them apart.
    gain
        How far chi-square would fall.
    values, errors
        What the numbers (n,) of the first would be, with standard errors: what is to be added to a
        leaf, as a part of it for `time_scale`. Of damping what is to be multiplied by a third of
        the trace of the inertia, 1/s if it is linear and 1/rad if it is quadratic.
    probability
        Of numbers as large as these by chance.
    moved
        Name of the number of the report that would move most, in standard errors.
    unit, shift
        Its unit, and how far it would move.
    relative
        The shift over the number.
    standard_errors
        The shift over the standard error of the number.
    """

    names: tuple[str, ...]
    gain: float
    values: np.ndarray
    errors: np.ndarray
    probability: float
    moved: str
    unit: str
    shift: float
    relative: float
    standard_errors: float

    @property
    def name(self) -> str:
        """The names, joined by "or"."""
        return " or ".join(self.names)

    @property
    def is_certain(self) -> bool:
        """Whether it cannot be chance."""
        return self.probability < CHANCE

    @property
    def matters(self) -> bool:
        """Whether it cannot be chance, and the intervals do not cover it."""
        return self.is_certain and abs(self.standard_errors) > MOVED

    def __str__(self) -> str:
        count = "1 number" if len(self.values) == 1 else f"{len(self.values)} numbers"
        words = f"freeing {_listed(self.names)} would lower chi-square by {self.gain:.4g} ({count})"
        if not self.moved:
            return words
        unit = "" if self.unit == "1" else f" {self.unit}"
        size = f"{self.shift:+.2g}{unit}"
        if "moment" in self.moved:
            size = f"{100 * self.relative:+.2g} %"
        errors = abs(self.standard_errors)
        return f"{words} and move the {self.moved}, by {size} ({errors:.2g} standard errors)"


def _listed(names: Sequence[str]) -> str:
    return " or ".join(f"`{name}`" for name in names)


def find_suspects(
    scored: Sequence[Scored],
    numbers: Numbers,
    errors: np.ndarray,
) -> tuple[Suspect, ...]:
    """Suspects with what they would do to numbers (n,) with such errors, the worst first.

    Probabilities are those among all suspects. Those with one gain are one.
    """
    judged = np.isfinite(errors) & (errors > 0)
    groups: list[list[Scored]] = []
    for each in scored:
        if groups and abs(each.gain - groups[-1][0].gain) <= ALIKE * groups[-1][0].gain:
            groups[-1].append(each)
        else:
            groups.append([each])
    found: list[Suspect] = []
    for group in groups:
        # Which of one gain is the first would be decided by rounding.
        each, *_ = alike = sorted(group, key=lambda of_group: of_group.name)
        shift = numbers.jacobian @ each.step
        ratio = np.where(judged, shift / np.where(judged, errors, 1), 0)
        i = int(np.argmax(abs(ratio))) if len(ratio) else -1
        moved = i >= 0 and judged[i]
        value = numbers.values[i] if moved else 0.0
        found.append(
            Suspect(
                names=tuple(suspect.name for suspect in alike),
                gain=each.gain,
                values=each.values,
                errors=each.errors,
                probability=min(1.0, each.probability * len(scored)),
                moved=numbers.names[i] if moved else "",
                unit=numbers.units[i] if moved else "",
                shift=float(shift[i]) if moved else 0.0,
                relative=float(shift[i] / value) if value else 0.0,
                standard_errors=float(ratio[i]) if moved else 0.0,
            )
        )
    return tuple(found)


def describe_suspects(suspects: Sequence[Suspect]) -> Iterator[str]:
    """Those that may be more than chance, and what else was tried."""
    if not suspects:
        yield "what the model may leave out could not be tried"
    by_chance = [each for each in suspects if each.probability >= NOTED]
    yield from (str(each) for each in suspects if each.probability < NOTED)
    if by_chance:
        names = ", ".join(_listed(each.names) for each in by_chance)
        yield f"freeing {names} would gain no more than chance"


def describe_trajectories(part: FittedPart) -> Iterator[str]:
    """The least and the largest chi-square of a trajectory, for each degree of freedom."""
    chi_square, freedom = part.trajectory_chi_square, part.trajectory_freedom
    judged = freedom > 0
    if np.sum(judged) < 2:
        return
    ratio = np.where(judged, chi_square / np.where(judged, freedom, 1), np.nan)
    least, most = np.nanargmin(ratio), np.nanargmax(ratio)
    names = part.recordings.names
    yield (
        f"chi-square of a trajectory for each degree of freedom: {ratio[least]:.3g} "
        f"(`{names[least]}`) to {ratio[most]:.3g} (`{names[most]}`)"
    )


def differ_in_size(part: FittedPart) -> bool:
    """Whether the residuals differ more from trajectory to trajectory than by chance."""
    chi_square, freedom = part.trajectory_chi_square, part.trajectory_freedom
    judged = freedom > 0
    if part.model.is_robust or np.sum(judged) < 2 or not np.sum(chi_square[judged]):
        return False
    chi_square, freedom = chi_square[judged], freedom[judged]
    mean = np.sum(chi_square) / np.sum(freedom)
    return bool(np.min(chdtrc(freedom, chi_square / mean)) * len(freedom) < CHANCE)
