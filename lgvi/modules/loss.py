"""Robust losses, which bound the influence of outliers on a fit."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.typed_arrays import as_floats


class AbstractLoss(eqx.Module):
    r"""A robust loss $\rho(s)$ of the squared length $s = |r|^2$ of a whitened residual.

    It equals $s$ for small residuals and grows slower for large ones, so that a few readings that
    are far off do not decide the fit.
    """

    @abstractmethod
    def __call__(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The loss $\rho(s)$."""

    @abstractmethod
    def weight(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The weight $\rho'(s)$ of a residual, 1 for small ones."""


class Huber(AbstractLoss):
    r"""Huber's loss: $s$ up to $|r| = k$, then $2k|r| - k^2$, which is linear in the length.

    Parameters
    ----------
    threshold
        $k$, in standard deviations, positive, static.

    References
    ----------
    P. J. Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35 (1964),
    doi:10.1214/aoms/1177703732.
    """

    threshold: float = eqx.field(
        default=3.0, static=True, converter=lambda value: _as_threshold(value)
    )

    def __call__(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The loss $\rho(s)$."""
        s, k = jnp.asarray(s), self.threshold
        within = s <= k**2
        return jnp.where(within, s, 2 * k * jnp.sqrt(jnp.where(within, 1, s)) - k**2)

    def weight(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The weight $\rho'(s) = \min(1, k/|r|)$."""
        s, k = jnp.asarray(s), self.threshold
        within = s <= k**2
        return jnp.where(within, 1, k / jnp.sqrt(jnp.where(within, 1, s)))


class Cauchy(AbstractLoss):
    r"""Cauchy's loss $k^2\log(1 + s/k^2)$: readings far off hardly count.

    Parameters
    ----------
    threshold
        $k$, in standard deviations, positive, static.

    References
    ----------
    P. W. Holland, R. E. Welsch, "Robust regression using iteratively reweighted least-squares",
    Commun. Stat. Theory Methods 6 (1977), doi:10.1080/03610927708827533.
    """

    threshold: float = eqx.field(
        default=3.0, static=True, converter=lambda value: _as_threshold(value)
    )

    def __call__(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The loss $\rho(s)$."""
        return self.threshold**2 * jnp.log1p(jnp.asarray(s) / self.threshold**2)

    def weight(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The weight $\rho'(s) = 1/(1 + s/k^2)$."""
        return 1 / (1 + jnp.asarray(s) / self.threshold**2)


def _as_threshold(value: float) -> float:
    as_floats(threshold=(value, ()))  # raises if it is not a number
    if not float(value) > 0:
        raise ValueError(f"Argument `threshold` must be positive, but is {value!r}.")
    return float(value)
