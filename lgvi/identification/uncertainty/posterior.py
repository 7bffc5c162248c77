"""What is known of the free leaves of a model, and of any function of the model."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy.special import ndtri, stdtrit

from ..compilation import compiled
from ..model.free import Free, inertia_and_derivative, unravel
from ..model.model import Model
from .information import Information

Quantity = Callable[[Any], Any]  # of a model


class LinearErrors(Protocol):
    """Errors of numbers that are linear in the free leaves, about."""

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Covariance (m, m) of numbers with a Jacobian (m, p); infinite where not observable."""
        ...

    def freedom_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Degrees of freedom of the variance of each number (m,)."""
        ...


class Independent(NamedTuple):
    """Errors where all residuals are independent, and of one size."""

    information: Information
    variance: float  # the factor on the covariance for unit noise
    freedom: float  # degrees of freedom of the variance, infinite where it is known

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        return self.variance * self.information.covariance_of(jacobian)

    def freedom_of(self, jacobian: np.ndarray) -> np.ndarray:
        return np.full(len(jacobian), self.freedom)


class Spread(NamedTuple):
    """How well numbers (n,) are known; errors are infinite where a number is not observable."""

    error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def spread_about(
    values: np.ndarray, jacobian: np.ndarray, errors: LinearErrors, level: float
) -> Spread:
    """Standard errors, and intervals that contain the truth with a probability of `level`."""
    error = np.sqrt(np.diag(errors.covariance_of(jacobian)))
    freedom, tail = errors.freedom_of(jacobian), (1 + level) / 2
    finite = np.isfinite(freedom) & (freedom > 0)
    width = error * np.where(finite, stdtrit(np.where(finite, freedom, 1), tail), ndtri(tail))
    return Spread(error, values - width, values + width)


class AbstractPosterior(eqx.Module):
    """The free leaves of a model, and what is known of them.

    Attributes
    ----------
    model
        The model.
    unobservable
        The directions of the free leaves that are not observable, in words.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    variance
        The factor on the covariance for unit noise.
    free, information
        The free leaves as a vector, and the information on the vector.
    """

    model: eqx.AbstractVar[Model]
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

    @property
    def body(self):
        """The body with the estimated leaves; of unit trace if the scale is not observable."""
        return self.model.body

    @property
    def scale_is_observable(self) -> bool:
        """Whether the scale of the inertia is observable, and not only its ratios."""
        _, derivative = inertia_and_derivative(self.model, self.free)
        return not self.information.unknown(np.trace(derivative)[None])[0]

    def linearise(self, quantity: Quantity | None) -> tuple[np.ndarray, np.ndarray]:
        """A quantity, raveled to n numbers, and its Jacobian (n, p); by default the free leaves."""
        if quantity is None:
            return self.free.theta, np.eye(len(self.free.theta))
        theta = self.free.theta.astype(jax.dtypes.canonicalize_dtype(float))
        values, jacobian = _linearised(quantity, self.model, self.free, theta, few=False)
        return np.asarray(values, float), np.asarray(jacobian, float)

    def shaped(self, quantity: Quantity | None, numbers: np.ndarray) -> Any:
        """Numbers in the shape of a quantity; by default a model with the free leaves alone."""
        value = (
            eqx.filter(self.model, self.free.selected) if quantity is None else quantity(self.model)
        )
        return unravel(jax.tree.map(jnp.asarray, value), numbers)

    def evaluate(self, quantity: Quantity, theta: np.ndarray) -> np.ndarray:
        """A quantity, raveled to n numbers, at each of some values (draws, p) of the leaves."""
        theta = theta.astype(jax.dtypes.canonicalize_dtype(float))
        return np.asarray(_evaluated(quantity, self.model, self.free, theta, few=False), float)


def _raveled(quantity: Quantity, model: Model, free: Free) -> Callable[[Array], Array]:
    return lambda theta: ravel_pytree(quantity(free.model(model, theta)))[0]


@compiled
def _linearised(
    quantity: Quantity, model: Model, free: Free, theta: Array | np.ndarray
) -> tuple[Array, Array]:
    numbers, theta = _raveled(quantity, model, free), jnp.asarray(theta)
    return numbers(theta), jax.jacfwd(numbers)(theta)


@compiled
def _evaluated(quantity: Quantity, model: Model, free: Free, theta: Array | np.ndarray) -> Array:
    return jax.vmap(_raveled(quantity, model, free))(jnp.asarray(theta))
