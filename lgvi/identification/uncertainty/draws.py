"""Draws of the posterior, and what they tell of any function of the model."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model.free_leaves import Free, Quantity
from ..running.compilation import compiled
from .information import Information
from .posterior import AbstractPosterior, Spread, require_level, spread_of_draws
from .report_table import make_table, wrap_lines

# The limits of A. Vehtari et al., "Rank-normalization, folding, and localization: an improved R^",
# Bayesian Analysis 16 (2021), doi:10.1214/20-BA1221, with 100 draws for each of four chains: an end
# of an interval of 95 % is then at a quantile that is right to a hundredth.
LARGEST_R_HAT, LEAST_SIZE = 1.01, 400
MOST_DIVERGENCES = 0.01  # part of the transitions, below what each end of the interval leaves out


class PosteriorDraws(AbstractPosterior):
    r"""Draws of the free leaves from their posterior, as `sample` of an estimate returns them.

    Attributes
    ----------
    parameters
        The parameters with the mean of the free leaves.
    draws
        The free leaves in each draw (chains, draws, p), in the order of `free.names`. Leaves along
        a direction that is not observable are about as estimated.
    r_hat
        The rank-normalised split $\hat R$ of each free leaf (p,): 1 where the chains agree. NaN
        for a leaf that is the same in all draws.
    effective_sample_size
        As many independent draws tell as much of each free leaf (p,), in the bulk or in the tails,
        whichever is less.
    divergences
        Number of transitions that were cut short as their energy was wrong.
    unobservable
        The directions of the free leaves that are not observable, in words.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    variance
        The factor on the covariance for unit noise, of the estimate.
    free, information
        The mean of the free leaves as a vector, and the information on the vector.
    """

    parameters: Any
    unobservable: tuple[str, ...]
    scaled: tuple[str, ...]
    variance: float
    free: Free
    information: Information
    draws: Float[np.ndarray, "chains draws p"]
    r_hat: Float[np.ndarray, " p"]
    effective_sample_size: Float[np.ndarray, " p"]
    divergences: int

    def evaluate(self, quantity: Quantity, theta: np.ndarray | None = None) -> Any:
        """A quantity in each draw.

        Parameters
        ----------
        quantity
            A function of the model that gives an array or a pytree of arrays, such as
            `lambda model: model.body.inertia`.
        theta
            Other values (n, p) of the free leaves, for which the quantity is raveled.

        Returns
        -------
        Any
            The values in the shape of the quantity, with (chains, draws) before it.
        """
        if theta is not None:
            return super().evaluate(quantity, theta)
        value = jax.tree.map(np.asarray, quantity(self.parameters))
        leaves, structure = jax.tree.flatten(value)
        parts = np.split(self._numbers(quantity), np.cumsum([x.size for x in leaves])[:-1], axis=1)
        before = self.draws.shape[:2]
        return jax.tree.unflatten(
            structure,
            [part.reshape(*before, *x.shape) for part, x in zip(parts, leaves, strict=True)],
        )

    def standard_error(self, quantity: Quantity | None = None) -> Any:
        """The standard deviation of a quantity, in its shape; infinite if it is not observable.

        Parameters
        ----------
        quantity
            As for `evaluate`. By default the free leaves: parameters with them alone.
        """
        return self.shaped(quantity, self._spread(quantity, 0.95).error)

    def interval(self, quantity: Quantity | None = None, level: float = 0.95) -> tuple[Any, Any]:
        """Intervals that contain the values with a probability, with equal tails.

        Parameters
        ----------
        quantity
            As for `standard_error`.
        level
            The probability, between 0 and 1.

        Returns
        -------
        tuple
            The ends, each in the shape of the quantity: quantiles of the draws. Infinite where the
            quantity is not observable.
        """
        require_level(level)
        spread = self._spread(quantity, level)
        return self.shaped(quantity, spread.lower), self.shaped(quantity, spread.upper)

    def spread_of(
        self,
        values: Float[np.ndarray, " n"],
        jacobian: Float[np.ndarray, "n p"],
        of_leaves: Callable[[np.ndarray], np.ndarray],
    ) -> Spread:
        """How well numbers are known; see `AbstractPosterior`."""
        return spread_of_draws(of_leaves(self._flat), self.information.unknown(jacobian), 0.95)

    def covariance_of(self, jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n n"]:
        """Covariance (n, n) of numbers with a Jacobian in the free leaves."""
        covariance = jacobian @ np.atleast_2d(np.cov(self._flat, rowvar=False)) @ jacobian.T
        return self.information.without_unknown(jacobian, covariance)

    def _spread(self, quantity: Quantity | None, level: float) -> Spread:
        _, jacobian = self.linearise(quantity)
        return spread_of_draws(self._numbers(quantity), self.information.unknown(jacobian), level)

    @property
    def _flat(self) -> np.ndarray:
        """The free leaves in all draws (chains * draws, p)."""
        return self.draws.reshape(-1, self.draws.shape[2])

    def _numbers(self, quantity: Quantity | None) -> np.ndarray:
        """A quantity, raveled to n numbers, in all draws (chains * draws, n)."""
        if quantity is None:
            return self._flat
        return super().evaluate(quantity, self._flat)

    def summary(self) -> dict[str, np.ndarray]:
        """The table of the report, as a dictionary of its columns; see `Estimate.summary`."""
        return make_table(self).as_arrays()

    def __str__(self) -> str:
        chains, draws, _ = self.draws.shape
        lines = [
            f"{chains} x {draws} draws of the posterior: standard deviations and quantiles; values "
            "are those of the mean of the free leaves",
            f"R-hat at most {np.nanmax(self.r_hat):.4f}, effective sample size at least "
            f"{np.nanmin(self.effective_sample_size):.0f}, {self.divergences} of "
            f"{chains * draws} transitions diverged",
            *(f"not observable: {words}" for words in self.unobservable),
        ]
        return "\n".join([str(make_table(self)), "", *wrap_lines(lines)])

    def __repr__(self) -> str:
        chains, draws, _ = self.draws.shape
        return f"PosteriorDraws({chains} x {draws} draws of {len(self.free.theta)} numbers)"

    def report(self) -> None:
        """Print a table of all estimated numbers, and how well the sampler worked."""
        print(self)


def diagnose(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R-hat and the effective sample size of leaves (chains, draws, p), each (p,)."""
    # The package takes JAX's usual rules for granted.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        numbers = np.array(_diagnose(theta.astype(jax.dtypes.canonicalize_dtype(float))), float)
    r_hat, size = np.where(np.all(theta == theta[:1, :1], axis=(0, 1)), np.nan, numbers)
    return r_hat, size


@compiled("diagnostics")
def _diagnose(theta: Array | np.ndarray) -> tuple[Array, Array]:
    import blackjax

    theta = jnp.asarray(theta)

    def of_leaf(x: Array) -> tuple[Array, Array]:
        return blackjax.rhat(x), jnp.minimum(blackjax.ess_bulk(x), blackjax.ess_tail(x))

    return jax.vmap(of_leaf, 2)(theta)


def require_convergence(posterior: PosteriorDraws) -> None:
    """Check that the draws tell the posterior.

    Raises
    ------
    RuntimeError
        If chains do not agree, draws are too few, or too many transitions diverge.
    """
    chains, draws, _ = posterior.draws.shape
    names, bad = np.array(posterior.free.names), []
    r_hat, size = posterior.r_hat, posterior.effective_sample_size
    if (apart := r_hat > LARGEST_R_HAT).any():
        bad.append(
            f"R-hat is above {LARGEST_R_HAT} for {', '.join(names[apart])}: at most "
            f"{np.nanmax(r_hat):.3f}"
        )
    if (few := size < LEAST_SIZE).any():
        bad.append(
            f"the effective sample size is below {LEAST_SIZE} for {', '.join(names[few])}: at "
            f"least {np.nanmin(size):.0f}"
        )
    if posterior.divergences > MOST_DIVERGENCES * chains * draws:
        bad.append(f"{posterior.divergences} of {chains * draws} transitions diverge")
    if bad:
        most = draws * LEAST_SIZE / min(LEAST_SIZE, np.nanmin(size))
        enough = 1000 * int(np.ceil(1.5 * most / 1000))
        raise RuntimeError(
            f"The draws do not tell the posterior: {'; '.join(bad)}. Take more `draws`, "
            f"{enough} or more; if that does not help, something is known too roughly: give the "
            "fit a `prior` for it, or fix it."
        )
