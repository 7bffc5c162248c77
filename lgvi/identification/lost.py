"""Windows in which a sensitive motion gets lost: their states, found in parts that grow slowly.

Near a spin about the middle axis errors grow exponentially. A state that is good enough for a short
window can be far too bad for one of eight times the length. Of thousands of windows a few are so.
Without this module all windows would be simulated many times more, until those few fit.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from .least_squares.levenberg_marquardt import NotSimulatedError, Point
from .least_squares.linearise import Linearised
from .model.states import InitialStates
from .problem import COARSE, FitProblem
from .windows.layout import Layout
from .windows.level import Level

LOST = 1000.0  # times the usual squares of residuals
FEW = 0.1  # of the windows, at most, that are fitted again
PARTS = 4, 2, 1  # of a window, the first of which is fitted


def recover(
    problem: FitProblem, level: Level, point: Point, found: Linearised
) -> InitialStates | None:
    """The states of windows, with those fitted in whose windows the motion got lost.

    None if there are no such windows, too many, or so few steps in all that nothing is gained.
    """
    are_small = (group.is_small for layout in level.layouts for group in layout.groups)
    if level.is_joined or all(are_small):
        return None
    sizes = [layout.groups[0].rows.sizes for layout in level.layouts]
    readings = np.concatenate([np.sum(each[:, 1:], axis=1) for each in sizes])
    squares = found.costs / np.maximum(readings, 1)
    lost = ~(squares <= LOST * np.median(squares))
    if not 0 < np.sum(lost) <= FEW * len(lost):
        return None
    states = point.states
    for k, (layout, part) in enumerate(zip(level.layouts, level.parts, strict=True)):
        alone = replace(
            problem,
            configurations=[problem.configurations[k]],
            methods=[problem.methods[k]],
            free=problem.free._replace(lower=point.theta, upper=point.theta),
            prior=(),
            checkpoint=None,
        )
        for group in layout.groups:
            some = np.flatnonzero(lost[part][group.index])
            if not len(some) or group.is_small:
                continue
            windows = [level.windows[k][i] for i in group.index[some]]
            at = part.start + group.index[some]
            of_some = states.at(at)
            with suppress(NotSimulatedError):
                for parts in PARTS:
                    beginnings = Layout((group.beginnings(some, parts),), None, layout.few)
                    here = Level((windows,), (beginnings,))
                    of_some = alone.minimise(here, COARSE, point.theta, of_some).states
                states = states.put(at, of_some)
    return states
