"""How the steps of a long trajectory are divided into pieces."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array

# Steps computed at once in a trajectory that is long or of which not every state is stored: many
# enough to hide what a piece costs, few enough to stay in the cache.
PIECE = 2000
# From here on even a trajectory of which every state is stored is computed in pieces: its
# derivative then takes less memory than the trajectory itself, and no longer.
LONG = 100_000

Integers = Array | np.ndarray


class Pieces(NamedTuple):
    """Pieces of equal length in groups; each group ends with a stored state.

    A group is one piece with several stored states, or several pieces from one stored state to
    the next. Where the steps do not fill its pieces, the last ones are of size zero.
    """

    stored: int  # states that are stored, beside the initial one
    save_every: int  # steps from one to the next
    groups: int
    of_group: int  # pieces of a group
    each: int  # states that a group stores
    length: int  # steps of a piece

    def first_and_count(self, group: Integers, piece: Integers) -> tuple[Integers, Integers]:
        """First step of a group's piece, and how many are not of size zero."""
        state, step = self.each * group, self.length * piece
        of_group = self.save_every * (self.stored - state).clip(max=self.each)
        return self.save_every * state + step, (of_group - step).clip(0, self.length)


def pieces_of(steps: int, save_every: int) -> Pieces | None:
    """Pieces of at most `PIECE` steps; None where all steps are computed at once."""
    if steps < LONG if save_every == 1 else steps <= PIECE:
        return None
    stored, of_group = steps // save_every, -(-save_every // PIECE)
    groups = -(-stored // max(PIECE // save_every, 1))
    each = -(-stored // groups)
    return Pieces(stored, save_every, groups, of_group, each, each * -(-save_every // of_group))
