"""Covariances of the free leaves of a model, and of any function of the model."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..compilation import compiled
from ..model.free import Free, inertia_and_derivative, unravel
from ..model.model import Model
from .information import Information


class AbstractPosterior(eqx.Module):
    """The free leaves of a model with their covariance.

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

    @property
    def body(self):
        """The body with the estimated leaves; of unit trace if the scale is not observable."""
        return self.model.body

    def covariance(self, quantity: Callable[[Any], Any] | None = None) -> Float[np.ndarray, "n n"]:
        r"""Covariance of a quantity, $G\,C\,G^T$ with its Jacobian $G$ (the delta method).

        Parameters
        ----------
        quantity
            A function of the model that gives an array or a pytree of some, which is raveled to n
            numbers, such as `lambda model: model.body.inertia`. By default the free leaves.

        Returns
        -------
        numpy.ndarray
            Covariance (n, n). A number that is not observable has infinite variance, and NaN for
            its covariances.
        """
        if quantity is None:
            return self.covariance_of(np.eye(len(self.free.theta)))
        theta = self.free.theta.astype(jax.dtypes.canonicalize_dtype(float))
        return self.covariance_of(
            np.asarray(_jacobian(quantity, self.model, self.free, theta, few=False))
        )

    def covariance_of(self, jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n n"]:
        """Covariance of numbers with a Jacobian (n, p) in the free leaves."""
        return self.variance * self.information.covariance_of(np.asarray(jacobian, float))

    def standard_error(self, quantity: Callable[[Any], Any] | None = None) -> Any:
        """Standard error of a quantity, in its shape; infinite where it is not observable.

        Parameters
        ----------
        quantity
            As for `covariance`. By default the free leaves: a model with them alone.
        """
        errors = np.sqrt(np.diag(self.covariance(quantity)))
        value = (
            eqx.filter(self.model, self.free.selected) if quantity is None else quantity(self.model)
        )
        return unravel(jax.tree.map(jnp.asarray, value), errors)

    @property
    def scale_is_observable(self) -> bool:
        """Whether the scale of the inertia is observable, and not only its ratios."""
        _, derivative = inertia_and_derivative(self.model, self.free)
        return bool(np.isfinite(self.covariance_of(np.trace(derivative)[None])))


@compiled
def _jacobian(
    quantity: Callable[[Any], Any], model: Model, free: Free, theta: Array | np.ndarray
) -> Array:
    def raveled(theta: Array) -> Array:
        return ravel_pytree(quantity(free.model(model, theta)))[0]

    return jax.jacfwd(raveled)(jnp.asarray(theta))
