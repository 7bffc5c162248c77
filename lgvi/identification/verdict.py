"""Whether the model of an estimate holds, in words."""

from collections.abc import Sequence

from .abstract_estimate import AbstractEstimate
from .contradictions import Halves, below_zero, implausible
from .diagnosis.doubts import CHANCE, Suspect, differ_in_size
from .uncertainty.noise import NO_NOISE

MOST_NAMED = 3  # trajectories in a verdict
MUCH_LARGER = 10.0  # residuals than a guess of the noise


def judge(estimate: AbstractEstimate, suspects: Sequence[Suspect], halves: Halves) -> str:
    """Whether the model holds; see `verdict` of the estimate."""
    if not estimate.degrees_of_freedom:
        return "nothing tells whether the model holds, as no more was read than is fitted"
    against, allowed = [*estimate.mistakes], []
    # Beside a mistake suspects mean nothing, and after the first they are often its shadows.
    suspects = () if estimate.mistakes else suspects
    certain = [each for each in suspects if each.is_certain]
    matters = [each for each in certain if each.matters]
    against += map(str, matters[:1])
    allowed += map(str, certain[:1])
    against += estimate.reasons
    if estimate.converged:
        against += below_zero(estimate)
    against += [f"{words} is implausible" for words in implausible(estimate)]
    scatter = []  # what independent errors do not allow for
    for name, part in estimate.parts.items():
        where = f" of `{name}`" if len(estimate.parts) > 1 else ""
        if outliers := part.outliers:
            words = f"{_count(outliers)} not fit"
            words = f"in `{name}` {words}" if where else words
            (allowed if part.model.is_robust else against).append(words)
        correlated = [each for each, r in part.correlations.items() if r.is_certain]
        for channel, times in part.usual_residuals.items():
            if estimate.errors != "independent" and times > MUCH_LARGER:
                words = f"residuals of {channel}{where} are {times:.3g} times as large as `sigma`"
                (against if channel in correlated else allowed).append(words)
        if correlated and estimate.variance > NO_NOISE:
            scatter.append(f"residuals of {' and '.join(correlated)}{where} are correlated")
        if differ_in_size(part) and estimate.variance > NO_NOISE:
            scatter.append(f"residuals differ in size from trajectory to trajectory{where}")
    if halves.probability < CHANCE:
        against.append(
            f"halves of the data are {abs(halves.apart):.2g} standard errors apart ({halves.name})"
        )
    if against:
        return f"the model does not hold: {'; '.join(against)}"
    if scatter and estimate.errors == "independent":
        return f"the model may hold, but independent errors do not: {'; '.join(scatter)}"
    holds = "the model holds"
    if allowed or scatter:
        holds += f" with the intervals given: {'; '.join([*allowed, *scatter])}"
    if estimate.score_tests.not_tried:
        holds += " (what it may leave out was not tried)"
    return holds


def _count(outliers: tuple[str, ...]) -> str:
    """Such as `trajectory a does`, or `5 trajectories (a, b, c, ...) do`."""
    named = ", ".join(f"`{name}`" for name in outliers[:MOST_NAMED])
    if len(outliers) == 1:
        return f"trajectory {named} does"
    more = ", ..." if len(outliers) > MOST_NAMED else ""
    return f"{len(outliers)} trajectories ({named}{more}) do"
