"""Standard errors of an experiment, before any data."""

from collections.abc import Callable
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from ..modules.integrator import MoserVeselovIntegrator
from .checks import in_one_precision, require_model, require_noise
from .data.recordings import Recordings
from .fit.problem import Problem
from .model.configuration import Configuration
from .model.free_leaves import Free, Quantity
from .model.model import Model
from .model.prior import Priors, as_priors
from .model.selection import Where, add_state_leaves, body_of, select_free_leaves
from .model.states import InitialStates
from .running.progress import show_progress
from .segments.levels import choose_method, first_steps, whole_level
from .simulate import simulate_recordings
from .start.measured import largest_rates, require_turns
from .uncertainty.information import Information, compute_information
from .uncertainty.observability import LinearPosterior, describe, describe_unseen_turns
from .uncertainty.posterior import AbstractPosterior, Independent, Spread, spread_about
from .uncertainty.report_table import make_table, wrap_lines


class Identifiability(AbstractPosterior):
    """The standard errors that an experiment would give, with the noise of the model's sensors.

    Attributes
    ----------
    parameters
        The model at which the standard errors hold.
    unobservable
        The directions of the free leaves that would not be observable, and a turn of the initial
        attitudes that would not be observable, in words, and what would make these observable.
    scaled
        Names of the leaves that would be known only as parts of the trace of the inertia.
    variance
        1: the noise is exactly as given.
    free, information
        The free leaves as a vector, and the information on the vector.
    """

    parameters: Model
    unobservable: tuple[str, ...]
    scaled: tuple[str, ...]
    variance: float
    free: Free
    information: Information

    @property
    def model(self) -> Model:
        """The model at which the standard errors hold."""
        return self.parameters

    @property
    def body(self):
        """The body of the model; of unit trace if the scale would not be observable."""
        return self.model.body

    def covariance(self, quantity: Quantity | None = None) -> Float[np.ndarray, "n n"]:
        r"""Covariance of a quantity, $G\,C\,G^T$ with its Jacobian $G$ (the delta method).

        Parameters
        ----------
        quantity
            A function of the model that gives an array or a pytree of arrays, which is raveled to
            n numbers, such as `lambda model: model.body.inertia`. By default the free leaves.

        Returns
        -------
        numpy.ndarray
            Covariance (n, n). A number that is not observable has infinite variance, and NaN for
            its covariances.
        """
        _, jacobian = self.linearise(quantity)
        return self.covariance_of(jacobian)

    def covariance_of(self, jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n n"]:
        """Covariance (n, n) of numbers with a Jacobian in the free leaves."""
        return self.variance * self.information.covariance_of(jacobian)

    def standard_error(self, quantity: Quantity | None = None) -> Any:
        """Standard error of a quantity, in its shape; infinite where it is not observable.

        Parameters
        ----------
        quantity
            As for `covariance`. By default the free leaves: a model with them alone.
        """
        return self.shaped(quantity, np.sqrt(np.diag(self.covariance(quantity))))

    def spread_of(
        self,
        values: Float[np.ndarray, " n"],
        jacobian: Float[np.ndarray, "n p"],
        of_leaves: Callable[[np.ndarray], np.ndarray],
    ) -> Spread:
        """How well numbers would be known; see `AbstractPosterior`."""
        no_rows = self.information.whiten(np.zeros((0, jacobian.shape[1])))
        return spread_about(
            values, jacobian, Independent(self.information, 1.0, np.inf, no_rows), 0.95
        )

    @property
    def singular_values(self) -> Float[np.ndarray, " leaves"]:
        """Singular values of the whitened Jacobian in the free leaves, initial states eliminated.

        The inverse of each is the standard error along its direction; zero, to rounding, is a
        direction that is not observable.
        """
        return self.information.singular_values()

    @show_progress("report")
    def __str__(self) -> str:
        values = ", ".join(f"{value:.3g}" for value in self.singular_values)
        lines = [f"singular values of the whitened Jacobian: {values}"]
        lines += [f"not observable: {words}" for words in self.unobservable]
        return "\n".join([str(make_table(self)), "", *wrap_lines(lines)])

    @show_progress("report")
    def to_html(self, file: str | PathLike[str]) -> Path:
        """Write the report with pictures as a page by itself, for a browser and to print.

        Parameters
        ----------
        file
            The page, such as `"plan.html"`. It needs no network.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        ImportError
            If Matplotlib is not installed.
        """
        # Pictures stand on results, so that they are imported when they are drawn.
        return import_module("lgvi.plotting.report").write_report(self, file)

    def report(self) -> None:
        """Print a table of the standard errors to expect, and what would not be observable."""
        print(self)


@show_progress("identifiability")
def identifiability(
    model: Model,
    layout: Recordings | ArrayLike,
    states: InitialStates,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    free: Where = body_of,
    prior: Priors = (),
) -> Identifiability:
    """Standard errors and unobservable directions of an experiment, before any data.

    The motion is simulated, and the derivative of what the sensors read is taken with respect to
    the free leaves and the initial states, which are unknown too.

    Parameters
    ----------
    model, layout, states, integrator
        The experiment, as for
        [`simulate_recordings`][lgvi.identification.simulate_recordings].
    free
        What is to be estimated, as for [`identify`][lgvi.identification.identify].
    prior
        What is known beforehand, as for [`identify`][lgvi.identification.identify]: such as
        `estimate.as_prior()`, for an experiment that comes after another one.

    Returns
    -------
    Identifiability
        Standard errors to expect, singular values, and the directions that are not observable.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together.
    RuntimeError
        If a step of the integrator does not converge.
    """
    recordings = simulate_recordings(model, layout, states, integrator)
    model = in_one_precision(model)
    require_model(model, recordings)
    require_noise(model)
    selected = select_free_leaves(model, free, ())
    speeds = largest_rates(model, recordings, states)
    if integrator is None:
        require_turns(recordings, speeds)
    method = choose_method(model, recordings, integrator)
    longest_step = first_steps(integrator, speeds, Problem.turn_of_step)
    own_leaves = add_state_leaves(None, model, selected.selected)
    configuration = Configuration("", recordings, model, None, selected.selected, own_leaves)
    level = whole_level([configuration], [longest_step])
    dtype = jax.dtypes.canonicalize_dtype(float)
    if own_leaves is not None and states.own is None:
        own_start = np.tile(configuration.own_start, (len(recordings), 1))
        states = InitialStates(states.R, states.omega, own_start)
    states = jax.tree.map(lambda x: np.asarray(x, dtype), states)
    priors = as_priors(prior, model, selected)
    fit_problem = Problem(model, selected, [configuration], prior=priors, methods=[method])
    problem = fit_problem.linearise(level, selected.theta, states)
    if not np.isfinite(problem.cost):
        raise RuntimeError("A step did not converge: take an `integrator` with a shorter `dt`.")
    known = compute_information(problem.system, np.zeros(len(selected.theta), bool))
    described = describe(model, LinearPosterior(selected, known, variance=1.0))
    turns = describe_unseen_turns(known.unseen_turn_axes, np.asarray(states.R))
    described = described._replace(unobservable=(*described.unobservable, *turns))
    return Identifiability(**described._asdict(), variance=1.0)
