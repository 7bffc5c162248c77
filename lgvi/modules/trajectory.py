"""The result of a simulation."""

from typing import NamedTuple

from jaxtyping import Array, Float

from ..core.step.solve import SolverInfo
from .printing import show


class Trajectory(NamedTuple):
    """Stored states: the states at the ends of all steps, or of every `save_every`-th step.

    Attributes
    ----------
    R
        Attitudes (states, 3, 3), body to space, the initial one included.
    pi
        Body angular momenta (states, 3), kg m²/s, the initial one included.
    solver_info
        Of the steps from each stored state to the next (states-1,): the largest residual norm,
        and whether all steps converged, with all parts of composed steps.
    """

    R: Float[Array, "states 3 3"]
    pi: Float[Array, "states 3"]
    solver_info: SolverInfo

    def __repr__(self) -> str:
        of_solver = show(self.solver_info)
        return f"Trajectory(R={show(self.R)}, pi={show(self.pi)}, solver_info={of_solver})"
