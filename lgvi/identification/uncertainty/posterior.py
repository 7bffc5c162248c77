"""What is known of the free leaves, and which kind of standard errors holds for recordings."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any, Literal, NamedTuple, Protocol, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ndtri, stdtrit

from ..model.free_leaves import (
    Free,
    Quantity,
    evaluate_quantity,
    inertias_and_derivatives,
    linearise_quantity,
    unravel,
)
from ..model.prior import PriorTriple
from .information import Information

LEAST_INDEPENDENT = 1e-8  # smallest eigenvalue of correlations that is no rounding
FEWEST_TRAJECTORIES = 10  # for errors of whole trajectories, by default
Noise = Literal["residuals", "given"]
Errors = Literal["independent", "clustered", "correlated", "bootstrap"]


def require_errors(errors: str, trajectories: Sequence[int], in_all: int) -> None:
    """Check a kind of standard errors against the numbers of trajectories of the configurations.

    `in_all` is the number of trajectories of all configurations and processes.

    Raises
    ------
    ValueError
        If there is no such kind, or the kind needs more trajectories.
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
    """The kind of standard errors that holds as far as the recordings can tell, and why."""
    if noise == "given":
        return "independent", "chosen, as the noise is given"
    if freedom == 0:
        return "independent", "chosen, as no more was read than is fitted"
    if trajectories >= FEWEST_TRAJECTORIES:
        return "clustered", f"chosen, as there are {FEWEST_TRAJECTORIES} trajectories or more"
    return "correlated", f"chosen, as there are less than {FEWEST_TRAJECTORIES} trajectories"


class LinearErrors(Protocol):
    """Errors of numbers that are approximately linear in the free leaves."""

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Covariance (m, m) of numbers with a Jacobian (m, p); infinite where not observable."""
        ...

    def freedom_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Degrees of freedom of the variance of each number (m,)."""
        ...


class Independent(NamedTuple):
    """Errors where all residuals are independent and have one variance."""

    information: Information
    variance: float  # the factor on the covariance for unit noise
    freedom: float  # degrees of freedom of the variance, infinite where it is known
    prior: np.ndarray  # (rows, k), whitened rows of a prior, whose errors are known

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        return self.variance * self.information.covariance_of(jacobian)

    def freedom_of(self, jacobian: np.ndarray) -> np.ndarray:
        """As for the sandwich estimator: the part of the variance from a prior has no error."""
        gradients = self.information.whiten(jacobian)
        total = np.sum(gradients**2, axis=1)
        from_prior = np.sum((gradients @ self.prior.T) ** 2, axis=1)
        estimated = 1 - from_prior / np.where(total > 0, total, 1)
        return self.freedom / np.maximum(estimated, 1e-6) ** 2


class Spread(NamedTuple):
    """How well numbers (n,) are known; errors are infinite where a number is not observable."""

    error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    freedom: np.ndarray  # degrees of freedom of the interval; NaN for quantiles of draws


def spread_about(
    values: np.ndarray, jacobian: np.ndarray, errors: LinearErrors, level: float
) -> Spread:
    """Standard errors, and intervals that contain the truth with a probability of `level`."""
    error = np.sqrt(np.diag(errors.covariance_of(jacobian)))
    freedom, tail = errors.freedom_of(jacobian), (1 + level) / 2
    finite = np.isfinite(freedom) & (freedom > 0)
    width = error * np.where(finite, stdtrit(np.where(finite, freedom, 1), tail), ndtri(tail))
    return Spread(error, values - width, values + width, freedom)


def spread_of_draws(draws: np.ndarray, unknown: np.ndarray, level: float) -> Spread:
    """The scatter of numbers in draws (draws, n), and intervals from their quantiles.

    Infinite where a number is `unknown` (n,), not observable.
    """
    ends = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
    lower, upper = np.where(unknown, [[-np.inf], [np.inf]], ends)
    error = np.where(unknown, np.inf, np.std(draws, axis=0, ddof=1))
    return Spread(error, lower, upper, np.full(len(error), np.nan))


def require_level(level: float) -> None:
    """Check the probability of an interval."""
    if not (isinstance(level, Real) and 0 < level < 1):
        raise ValueError(
            f"Argument `level` must be a probability between 0 and 1, but is {level!r}."
        )


class WhitenedLeaves(eqx.Module):
    """A function of parameters that have some leaves: linear combinations (n,) of these.

    Where the recordings do not tell the scale of the inertia, the leaves are those of an inertia of
    unit trace, whatever the scale of the parameters is.
    """

    names: tuple[str, ...] = eqx.field(static=True)  # of the leaves, by their paths
    over_trace: bool = eqx.field(static=True)  # whether the scale is not known
    rows: np.ndarray  # (n, p)
    by_scale: np.ndarray  # (p,), change of a leaf by the logarithm of the scale; zero where none
    scaled: np.ndarray  # (p,), whether a leaf is proportional to the scale

    def __call__(self, parameters: Any) -> Array:
        paths = jax.tree_util.tree_leaves_with_path(parameters)
        leaves = {jax.tree_util.keystr(path): leaf for path, leaf in paths}
        if missing := [name for name in self.names if name not in leaves]:
            raise ValueError(f"what is known is of leaves that are not there: {', '.join(missing)}")
        vector = jnp.concatenate([leaves[name].ravel() for name in self.names])
        if self.over_trace:
            trace = jnp.trace(parameters.body.inertia).astype(vector.dtype)
            vector = jnp.where(self.scaled, vector / trace, vector)
            vector = vector - jnp.asarray(self.by_scale, vector.dtype) * jnp.log(trace)
        return jnp.asarray(self.rows, vector.dtype) @ vector


class AbstractPosterior(eqx.Module):
    """The free leaves of parameters, and what is known of the leaves.

    Attributes
    ----------
    parameters
        The parameters, such as a model.
    unobservable
        The directions of the free leaves that are not observable, in words.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    variance
        The factor on the covariance for unit noise.
    free, information
        The free leaves as a vector, and the information on the vector.
    """

    parameters: eqx.AbstractVar[Any]
    unobservable: eqx.AbstractVar[tuple[str, ...]]
    scaled: eqx.AbstractVar[tuple[str, ...]]
    variance: eqx.AbstractVar[float]
    free: eqx.AbstractVar[Free]
    information: eqx.AbstractVar[Information]

    @abstractmethod
    def spread_of(
        self,
        values: Float[np.ndarray, " n"],
        jacobian: Float[np.ndarray, "n p"],
        of_leaves: Callable[[np.ndarray], np.ndarray],
    ) -> Spread:
        """How well numbers are known, with 95 % intervals.

        Parameters
        ----------
        values, jacobian
            The numbers at the estimate, and their Jacobian in the free leaves.
        of_leaves
            The numbers (draws, n) at other values of the free leaves (draws, p).
        """

    @abstractmethod
    def covariance_of(self, jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n n"]:
        """Covariance (n, n) of numbers with a Jacobian in the free leaves."""

    def as_prior(self) -> tuple[PriorTriple, ...]:
        """What is known of the free leaves, as the `prior` of another fit or of a plan.

        Returns
        -------
        tuple
            One triple of a function of the parameters, a mean and a standard deviation: numbers of
            which the errors are independent and normal, with a standard deviation of 1. Directions
            that are not observable, and leaves at a bound, are left out.

        Raises
        ------
        ValueError
            If the standard errors are of no more trajectories than there are observable directions.
        """
        known, free = self.information, self.free
        rows = known.directions[known.observable] * known.scale
        covariance = self.covariance_of(rows)
        variances = np.diag(covariance)
        if not len(rows) or not np.all(np.isfinite(variances) & (variances > 0)):
            raise ValueError("What the recordings tell must have finite errors, to be a prior.")
        deviations = np.sqrt(variances)
        correlation = covariance / np.outer(deviations, deviations)
        if np.linalg.eigvalsh(correlation)[0] < LEAST_INDEPENDENT:
            raise ValueError(
                f"The standard errors must be of more trajectories than {len(rows)}, the number of "
                'what is known, to be a prior: take `with_errors("independent")` of the estimate.'
            )
        whitened = np.linalg.solve(np.linalg.cholesky(correlation), rows / deviations[:, None])
        chosen = eqx.filter(self.parameters, free.selected)
        paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(chosen)]
        names = tuple(map(jax.tree_util.keystr, paths))
        over_trace = [body.name for body in free.bodies] == [""] and not self.scale_is_observable
        scaled = np.isin(free.leaves, self.scaled)
        function = WhitenedLeaves(names, over_trace, whitened, free.scale_direction, scaled)
        return ((function, whitened @ free.theta, 1.0),)

    @property
    def scale_is_observable(self) -> bool:
        """Whether the scale of the inertia is observable, and not only its ratios."""
        _, derivatives = inertias_and_derivatives(self.parameters, self.free)
        traces = np.trace(derivatives, axis1=1, axis2=2)
        return not np.any(self.information.unknown(traces))

    def linearise(self, quantity: Quantity | None) -> tuple[np.ndarray, np.ndarray]:
        """A quantity, raveled to n numbers, and its Jacobian (n, p); by default the free leaves."""
        free = self.free
        if quantity is None:
            return free.theta, np.eye(len(free.theta))
        return linearise_quantity(quantity, self.parameters, free, free.theta)

    def shaped(self, quantity: Quantity | None, numbers: np.ndarray) -> Any:
        """Numbers in the shape of a quantity; by default parameters with the free leaves alone."""
        parameters = self.parameters
        value = (
            eqx.filter(parameters, self.free.selected) if quantity is None else quantity(parameters)
        )
        return unravel(jax.tree.map(jnp.asarray, value), numbers)

    def evaluate(self, quantity: Quantity, theta: np.ndarray) -> np.ndarray:
        """A quantity, raveled to n numbers, at several values (draws, p) of the leaves."""
        return evaluate_quantity(quantity, self.parameters, self.free, theta)
