"""The result of a simulation."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ..core.step.solution import SolverInfo
from .printing import show


class Trajectory(eqx.Module):
    """Stored states: the states at the ends of all steps, of some steps, or at given times.

    `Rs, pis, info = trajectory` are its first three attributes.

    Attributes
    ----------
    R
        Attitudes (states, 3, 3), body to space, the initial one included.
    pi
        Body angular momenta (states, 3), kg m²/s, the initial one included.
    solver_info
        Of the steps from each stored state to the next (states-1,): the largest residual norm,
        and whether all steps converged, with all parts of composed steps.
    t
        Times of the states (states,), s.
    x, v
        Positions, m, and velocities, m/s, of the centre of mass (states, 3), space frame, the
        initial ones included; None where the motion of the centre of mass was not asked for.
    """

    R: Float[Array, "states 3 3"]
    pi: Float[Array, "states 3"]
    solver_info: SolverInfo
    t: Float[Array, " states"]
    x: Float[Array, "states 3"] | None = None
    v: Float[Array, "states 3"] | None = None

    def __repr__(self) -> str:
        return show(self)

    def __iter__(self) -> Iterator[Any]:
        return iter((self.R, self.pi, self.solver_info))

    def __getitem__(self, index: int | slice) -> Any:
        return tuple(self)[index]

    def __len__(self) -> int:
        return 3
