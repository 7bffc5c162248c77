"""The kinds of standard errors, and which of them holds for recordings."""

from collections.abc import Sequence
from typing import Literal, get_args

FEWEST_TRAJECTORIES = 10  # for errors of whole trajectories, by default
Noise = Literal["residuals", "given"]
Errors = Literal["independent", "clustered", "correlated", "bootstrap"]


def require_errors(errors: str, trajectories: Sequence[int], in_all: int) -> None:
    """Check a kind of standard errors, for so many trajectories of each configuration.

    `in_all` are those of all configurations and processes.

    Raises
    ------
    ValueError
        If there is no such kind, or it needs more trajectories.
    """
    if not isinstance(errors, str) or errors not in get_args(Errors):
        kinds = ", ".join(f'"{kind}"' for kind in get_args(Errors))
        raise ValueError(f"Argument `errors` must be one of {kinds}, but is {errors!r}.")
    if in_all < 2 and errors in ("clustered", "bootstrap"):
        raise ValueError(
            f'Argument `errors` must be "correlated" or "independent" for a single trajectory, but '
            f'is "{errors}", which compares trajectories.'
        )
    if in_all > sum(trajectories) and errors == "bootstrap":
        raise ValueError(
            'Argument `errors` must not be "bootstrap" where several processes fit together, none '
            "of which has all trajectories to draw from."
        )
    if min(trajectories) < 2 and errors == "bootstrap":
        raise ValueError(
            'Argument `errors` must not be "bootstrap" where a configuration has one trajectory '
            "alone, of which nothing else can be drawn."
        )


def choose_errors(trajectories: int, freedom: int, noise: Noise) -> tuple[Errors, str]:
    """The kind of standard errors that holds for recordings, as far as these can tell, and why."""
    if noise == "given":
        return "independent", "chosen, as the noise is given"
    if freedom == 0:
        return "independent", "chosen, as no more was read than is fitted"
    if trajectories >= FEWEST_TRAJECTORIES:
        return "clustered", f"chosen, as there are {FEWEST_TRAJECTORIES} trajectories or more"
    return "correlated", f"chosen, as there are less than {FEWEST_TRAJECTORIES} trajectories"
