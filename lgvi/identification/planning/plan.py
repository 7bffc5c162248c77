"""The experiment that tells most about a model, within what the hardware can do."""

import csv
from collections.abc import Iterator, Mapping
from importlib import import_module
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from ...modules.arguments import require_instance
from ...modules.integrator import MoserVeselovIntegrator
from ...modules.sensors.gyroscope import Gyroscope
from ...modules.sensors.sensor import time_offset_of
from ..checks import in_one_precision, require_model, require_noise, require_rotations
from ..data.recordings import Recordings, stack_trajectories
from ..data.sample_checks import as_times
from ..identifiability import Identifiability, identifiability
from ..model.free_leaves import Free, Quantity, linearise_quantity, ravel
from ..model.model import Model
from ..model.prior import Prior, Priors, as_priors
from ..model.selection import Where, add_state_leaves, body_of, select_free_leaves
from ..model.states import InitialStates
from ..running.progress import show_progress
from ..simulate import simulate_recordings
from ..uncertainty.report_table import format_alike, make_table, wrap_lines
from .criterion import Criterion, require_criterion
from .limits import ROUNDING, Commands, Limits, LimitUse
from .manoeuvre import Experiment, Grid
from .search import RANDOM, Directions, Evaluated, Goal, Space, find_directions, search

LARGEST_CHANGE = 0.5  # of a logarithm that is a coordinate of an inertia, in a step to a draw
STEPS_OF_DRAW = 20
CANDIDATES = 4  # for each draw of a prior, as a body may be impossible
IMPOSSIBLE = 0.1  # standard deviations that such a body misses
FROM_PRIOR = 1e-9  # part of an information, at most, that is none of the plan
FASTEST = np.pi  # rad, from reading to reading, at most
Times = ArrayLike | Mapping[str, ArrayLike]


class Plan(eqx.Module):
    """An experiment within the limits of the hardware, and what it would tell.

    Attributes
    ----------
    states
        The initial states of the trajectories.
    recordings
        What would be read without noise, and the commands: a layout for
        [`simulate_recordings`][lgvi.identification.simulate_recordings] and
        [`identifiability`][lgvi.identification.identifiability].
    knots
        Times of the knots of the commands (knots,), s; empty where a body is thrown.
    commands
        The commands at the knots (trajectories, knots), by name, such as `"wheel 0"`.
    command_unit
        Their unit.
    limits
        The limits of the experiment.
    uses
        How much of each limit is taken: a [`LimitUse`][lgvi.identification.LimitUse] each.
    expected
        What the experiment would tell, with what is known before.
    usual
        The same of an experiment that nobody planned: of the random ones within the limits, from
        which the search starts, the middle one by the criterion.
    criterion, quantity
        The criterion, and what is to be known.
    converged
        Whether the search ended in a minimum.
    starts, starts_that_agree
        From how many random experiments the search went down, and how many of these searches ended
        within 1 % of the best.
    times, rates
        Times (times,), s, of the steps of the search, and angular velocities there
        (trajectories, times, 3), body frame, rad/s.
    """

    states: InitialStates
    recordings: Recordings
    knots: Float[np.ndarray, " knots"]
    commands: dict[str, Float[np.ndarray, "trajectories knots"]]
    command_unit: str
    limits: Limits
    uses: tuple[LimitUse, ...]
    expected: Identifiability
    usual: Identifiability
    criterion: Criterion
    quantity: Quantity | None
    converged: bool
    starts: int
    starts_that_agree: int
    times: Float[np.ndarray, " times"]
    rates: Float[np.ndarray, "trajectories times 3"]
    known: Float[np.ndarray, "p p"]  # information before the experiment

    @property
    def model(self) -> Model:
        """The model for which the experiment is planned."""
        return self.expected.model

    def standard_error(self, quantity: Quantity | None = None) -> Any:
        """Standard error to expect of a quantity, in its shape; infinite if not observable.

        Parameters
        ----------
        quantity
            A function of the model, as for
            [`Identifiability.covariance`][lgvi.identification.Identifiability.covariance]. By
            default the free leaves: a model with them alone.
        """
        return self.expected.standard_error(quantity)

    def covariance(self, quantity: Quantity | None = None) -> Float[np.ndarray, "n n"]:
        """Covariance (n, n) to expect of a quantity, raveled to n numbers."""
        return self.expected.covariance(quantity)

    def count_trajectories(self, quantity: Quantity, error: float) -> int:
        """Number of trajectories that bring the standard errors of a quantity to `error`.

        The trajectories of the plan are carried out again and again, all of them.

        Parameters
        ----------
        quantity
            A function of the model; each of its numbers is to be known as well.
        error
            The largest standard error, in the unit of the quantity.

        Returns
        -------
        int
            The number, a multiple of that of the plan.

        Raises
        ------
        ValueError
            If a number is not observable, or the error is not above 0.
        """
        if not 0 < error < np.inf:
            raise ValueError(f"Argument `error` must be above 0, but is {error!r}.")
        _, jacobian = self.expected.linearise(quantity)
        if not np.all(np.isfinite(np.diag(self.expected.covariance_of(jacobian)))):
            raise ValueError(
                "Argument `quantity` must be observable, but no number of trajectories of the "
                "plan shows it."
            )

        # In coordinates in which all information of plan and prior is 1, that of the prior is a.
        known = self.expected.information
        of_leaves = known.whiten(np.eye(len(self.known)))
        a, axes = np.linalg.eigh(of_leaves.T @ self.known @ of_leaves)
        a, squares = np.clip(a, 0, 1), (known.whiten(jacobian) @ axes) ** 2
        a = np.where(1 - a < FROM_PRIOR, 1, a)

        def largest(times: float) -> float:
            """The largest standard error where the plan is carried out so many times."""
            return float(np.sqrt(np.max(np.sum(squares / (a + times * (1 - a)), axis=1))))

        if largest(1e18) > error:
            raise ValueError(
                f"Argument `error` must be above {largest(1e18):.3g}, which comes from what is "
                f"known before, and no number of trajectories makes it smaller, but is {error!r}."
            )
        upper = 1
        while largest(upper) > error:
            upper *= 2
        lower = upper // 2
        while upper - lower > 1:
            middle = (lower + upper) // 2
            lower, upper = (middle, upper) if largest(middle) > error else (lower, middle)
        return upper * len(self.states.omega)

    def summary(self) -> dict[str, np.ndarray]:
        """The table of the report, as a dictionary of its columns.

        Returns
        -------
        dict
            `name`, `value`, the `standard_error` that the plan promises, `usual`, that of an
            experiment that nobody planned, and `unit`, each an array (numbers,). The quantity that
            is planned for comes first; its unit is not known.
        """
        planned = self._of_quantity()
        table, usual = make_table(self.expected), make_table(self.usual)
        # Where only one of the experiments shows the size of the inertia, units differ.
        rows = zip(usual.names, usual.units, strict=True)
        errors = dict(zip(rows, usual.spread.error, strict=True))
        return {
            "name": np.array([*planned[0], *table.names]),
            "value": np.append(planned[1], table.values),
            "standard_error": np.append(planned[2], table.spread.error),
            "usual": np.append(
                planned[3],
                [errors.get(row, np.inf) for row in zip(table.names, table.units, strict=True)],
            ),
            "unit": np.array([*[""] * len(planned[0]), *table.units]),
        }

    def _of_quantity(self) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
        """Names, values and standard errors of the quantity; those without a plan."""
        if self.quantity is None:
            return [], np.zeros(0), np.zeros(0), np.zeros(0)
        values, jacobian = self.expected.linearise(self.quantity)
        _, usual = self.usual.linearise(self.quantity)
        errors = np.sqrt(np.diag(self.expected.covariance_of(jacobian)))
        without = np.sqrt(np.diag(self.usual.covariance_of(usual)))
        count = len(values)
        names = ["quantity"] if count == 1 else [f"quantity[{k}]" for k in range(count)]
        return names, values, errors, without

    def table_cells(self) -> list[list[str]]:
        """The words of the table, with its head."""
        head = ["", "value", "std. error", "not planned", "times smaller", "unit"]
        cells, columns = [head], self.summary()
        order = "name", "value", "standard_error", "usual", "unit"
        for name, value, error, usual, unit in zip(*map(columns.get, order), strict=True):
            written = format_alike(value, error)
            known = np.isfinite(error) and error > 0
            ratio = usual / error if known and np.isfinite(usual) else np.nan
            gain = "" if np.isnan(ratio) else f"{ratio:.2g}" if ratio < 99.5 else f"{ratio:.0f}"
            errors = [written(x) if np.isfinite(x) else "inf" for x in (error, usual)]
            cells.append([str(name), written(value), *errors, gain, str(unit)])
        return cells

    def lines(self) -> list[str]:
        """What is to be done, which limits bind, and how the search ended, in words."""
        count = len(self.states.omega)
        duration = self.times[-1] - self.times[0]
        lines = [f"{count} {'trajectory' if count == 1 else 'trajectories'} of {duration:.4g} s"]
        if self.limits.largest_initial_rate > 0:
            for k, omega in enumerate(np.asarray(self.states.omega)):
                rates = ", ".join(f"{rate:.4g}" for rate in omega)
                lines.append(f"trajectory {k} starts at {rates} rad/s")
        for k in range(count):
            for name, values in self.commands.items():
                # Else zeros would be numbers such as 1e-14.
                zero = abs(values[k]) < ROUNDING * np.max(abs(values))
                words = ", ".join(f"{value:.4g}" for value in np.where(zero, 0.0, values[k]))
                lines.append(f"trajectory {k}, {name}: {words} {self.command_unit}")
        if self.commands:
            words = ", ".join(f"{t:.4g}" for t in self.knots)
            lines.append(f"commands are linear between these numbers, at {words} s")
        lines += [f"limit NOT KEPT: {use}" for use in self.uses if not use.is_kept]
        lines += [f"limit: {use}" for use in self.uses if use.is_kept and use.binds]
        if free := [use.name for use in self.uses if use.is_kept and not use.binds]:
            lines.append(f"limits that do not bind: {', '.join(free)}")
        if np.any(self.known):
            lines.append("what was known before counts in the standard errors")
        ended = "ended" if self.converged else "DID NOT END"
        agree = f"{self.starts_that_agree} of {self.starts} searches are within 1 % of the best"
        lines.append(f"search by the {self.criterion}-criterion: {ended} in a minimum; {agree}")
        return lines + [f"not observable: {words}" for words in self.expected.unobservable]

    def __str__(self) -> str:
        cells = self.table_cells()
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        rows = []
        for name, *numbers, unit in cells:
            right = [word.rjust(width) for word, width in zip(numbers, widths[1:-1], strict=True)]
            rows.append("  ".join([name.ljust(widths[0]), *right, unit]).rstrip())
        return "\n".join([*rows, "", *wrap_lines(self.lines())])

    def __repr__(self) -> str:
        count = len(self.states.omega)
        trajectories = "1 trajectory" if count == 1 else f"{count} trajectories"
        return f"Plan({trajectories}, {len(self.commands)} commands)"

    def report(self) -> None:
        """Print what to do, the standard errors to expect, and which limits bind."""
        print(self)

    def to_csv(self, file: str | PathLike[str], rate: float | None = None) -> None:
        """Write the commands to a CSV file, one row for each trajectory and time.

        Parameters
        ----------
        file
            The file. Its columns are `trajectory`; the angular velocity at the start, rad/s, where
            it is planned; and `t`, s, with the commands.
        rate
            Rows in a second, and one at the end. By default there is a row for each knot; without
            commands there is one for each trajectory.

        Raises
        ------
        ValueError
            If the rate is not above 0.
        """
        if rate is not None and not 0 < rate < np.inf:
            raise ValueError(f"Argument `rate` must be above 0, but is {rate!r}.")
        header, starts = ["trajectory"], self.limits.largest_initial_rate > 0
        if starts:
            header += [f"angular_velocity_{axis} (rad/s)" for axis in "xyz"]
        t = self.knots
        if self.commands:
            header += ["t (s)", *(f"{name} ({self.command_unit})" for name in self.commands)]
            if rate is not None:
                even = t[0] + np.arange(int((t[-1] - t[0]) * rate * (1 + 1e-12)) + 1) / rate
                t = np.append(even[even < t[-1] - 1e-9 / rate], t[-1])
        with open(file, "w", newline="", encoding="utf-8") as opened:
            writer = csv.writer(opened)
            writer.writerow(header)
            for k, omega in enumerate(np.asarray(self.states.omega, float)):
                begin = [k, *(omega.tolist() if starts else [])]
                curves = [np.interp(t, self.knots, x[k]) for x in self.commands.values()]
                rows = np.stack([t, *curves], axis=1).tolist() if self.commands else [[]]
                writer.writerows([*begin, *row] for row in rows)

    @show_progress("report")
    def to_html(self, file: str | PathLike[str]) -> Path:
        """Write the plan with pictures as a page by itself, for a browser and to print.

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


@show_progress("plan")
def plan(
    model: Model,
    times: Times,
    limits: Limits,
    *,
    free: Where = body_of,
    criterion: Criterion = "D",
    quantity: Quantity | None = None,
    prior: Priors = (),
    draws: int = 4,
    R0: Float[ArrayLike, "*trajectories 3 3"] | None = None,
    integrator: MoserVeselovIntegrator | None = None,
    seed: int = 0,
) -> Plan:
    r"""The experiment that tells most about what is free, within the limits of the hardware.

    Of the angular rates at the start and of the commands to the hardware those are searched for
    which the covariance $C$ of a quantity is least by Kiefer's criteria: the covariance that
    [`identifiability`][lgvi.identification.identifiability] gives, with unknown initial states. The
    derivative of the information with respect to the manoeuvre is exact. The search starts from
    random experiments within the limits, and goes down from the best of them.

    Parameters
    ----------
    model
        The body as it is expected, what acts on it, and the sensors with their noise.
    times
        Times (samples,), s, at which all sensors read each trajectory; or a mapping of the channels
        to the times of each.
    limits
        What the experiment may do: [`Limits`][lgvi.identification.Limits].
    free
        What is to be estimated, as for [`identify`][lgvi.identification.identify].
    criterion
        `"D"`: the volume of the ellipsoid of errors, which does not depend on units. `"A"`: the sum
        of the variances. `"E"`: the largest variance of any combination, so that no number stays
        behind. For a quantity that is one number all three are its standard error.
    quantity
        A function of the model that is to be known well, such as
        `lambda model: jnp.linalg.eigvalsh(model.body.inertia)`, of one unit. By default all free
        leaves, for `"D"` alone, as they have different units.
    prior
        What is known beforehand, as for [`identify`][lgvi.identification.identify]; after a first
        experiment `estimate.as_prior()`. It counts in the standard errors.
    draws
        With a prior the criterion is the mean over the model and so many draws of the prior, and
        the limits hold for each of these, and not for all bodies that the prior allows. 0 is the
        model alone.
    R0
        Attitudes at the start (3, 3) or (trajectories, 3, 3), body to space. By default the
        identity.
    integrator
        Its `order` and `dt`, for the standard errors to expect, as for
        [`identifiability`][lgvi.identification.identifiability].
    seed
        Of the random experiments and draws.

    Returns
    -------
    Plan
        What to do, in the units of the hardware, and the standard errors to expect.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together; if no experiment is within the limits, which names
        the limit; and if no experiment shows the quantity.
    RuntimeError
        If a step of the integrator does not converge.
    """
    require_instance("model", model, Model)
    require_instance("limits", limits, Limits)
    require_criterion(criterion)
    if quantity is not None and not callable(quantity):
        raise TypeError(
            f"Argument `quantity` must be a function of the model or None, but is {quantity!r}."
        )
    if not isinstance(seed, Integral) or seed < 0:
        raise ValueError(f"Argument `seed` must be a whole number from 0 on, but is {seed!r}.")
    if quantity is None and criterion != "D":
        raise ValueError(
            f'Argument `quantity` must be a function of the model for the criterion "{criterion}", '
            'but is None: only "D" does not depend on the units of all free leaves.'
        )
    if not isinstance(draws, Integral) or draws < 0:
        raise ValueError(f"Argument `draws` must be a whole number from 0 on, but is {draws!r}.")
    model = in_one_precision(model)
    require_noise(model)
    commands = None if limits.commands is None else limits.commands.of(model)
    of_channels = _times(times, model)
    if np.ptp(np.concatenate(list(of_channels.values()))) == 0:
        raise ValueError(f"Argument `times` must have two times at least, but is {times!r}.")
    _require_readable(of_channels, float(limits.rate), float(model.time_scale))
    selected = select_free_leaves(model, free, ())
    own = add_state_leaves(None, model, selected.selected)
    _require_limits(model, limits, selected)
    fastest = float(limits.rate)
    if commands is not None:  # rotors make a body nutate
        smallest = np.linalg.eigvalsh(np.asarray(model.body.inertia, float))[0]
        fastest += commands.largest_momentum / float(smallest)
    grid = Grid.of(of_channels, fastest * float(model.time_scale), commands)
    states = _states(R0, limits.trajectories)
    layout = _Layout(of_channels, commands, grid.knots)
    random = np.random.default_rng(seed)
    priors = as_priors(prior, model, selected)
    thetas, known = _draw_models(model, selected, priors, draws, random)
    own_start = np.zeros(0) if own is None else ravel(eqx.filter(model, own))
    space = Space(
        Experiment.of(model, selected.selected, own, grid, commands, limits),
        limits,
        thetas,
        np.asarray(states.R, float),
        np.tile(own_start, (limits.trajectories, 1)),
        known,
    )
    require_model(model, layout.recordings(space.at_knots(np.tile(space.calm, (1, 1)))))
    experiments = [space.draw_within(random) for _ in range(RANDOM)]
    goal = _goal(model, selected, criterion, quantity, thetas, find_directions(experiments))
    result = search(space, goal, experiments)

    def carried_out(evaluated: Evaluated) -> tuple[InitialStates, Recordings, Identifiability]:
        """The states, what is read without noise, and what it tells."""
        omega = evaluated.manoeuvres[:, :3].astype(states.omega.dtype)
        begin = InitialStates(states.R, omega)
        commanded = layout.recordings(space.at_knots(evaluated.manoeuvres))
        read = simulate_recordings(model, commanded, begin, integrator)
        told = identifiability(model, read, begin, integrator, free=free, prior=prior)
        return begin, read, told

    begin, read, expected = carried_out(result.best)
    if quantity is not None and not np.all(np.isfinite(np.diag(expected.covariance(quantity)))):
        raise ValueError(
            "Argument `limits` must allow an experiment that shows the `quantity`, but the best "
            "one does not: wider limits, more `knots` or longer `times` may show it."
        )
    *_, usual = carried_out(result.usual)
    columns = np.moveaxis(space.at_knots(result.best.manoeuvres), -1, 0)
    return Plan(
        states=begin,
        recordings=read,
        knots=grid.knots,
        commands={} if commands is None else dict(zip(commands.names, columns, strict=True)),
        command_unit="" if commands is None else commands.unit,
        limits=limits,
        uses=tuple(_uses(space, result.best)),
        expected=expected,
        usual=usual,
        criterion=criterion,
        quantity=quantity,
        converged=result.converged,
        starts=result.starts,
        starts_that_agree=result.agreeing,
        times=grid.t,
        rates=result.best.effects.rates[: limits.trajectories],
        known=_known(priors, expected.model, expected.free, expected.free.theta[None])[0],
    )


class _Layout(NamedTuple):
    """The times of readings, and the commands."""

    times: dict[str, np.ndarray]  # by channel
    commands: Commands | None
    knots: np.ndarray

    def recordings(self, at_knots: np.ndarray) -> Recordings:
        """Recordings without readings, with commands (trajectories, knots, columns)."""
        trajectories = []
        for values in at_knots:
            trajectory = {name: (t, np.zeros((len(t), 0))) for name, t in self.times.items()}
            if self.commands is not None:
                recorded = values @ self.commands.to_quantity
                trajectory[self.commands.quantity] = self.knots, recorded
            trajectories.append(trajectory)
        return stack_trajectories(trajectories, tuple(map(str, range(len(at_knots)))))


def _times(times: Times, model: Model) -> dict[str, np.ndarray]:
    if not isinstance(times, Mapping):
        return dict.fromkeys(model.sensors, as_times("times", times))
    if set(times) != set(model.sensors):
        raise ValueError(
            f"Argument `times` must have the channels {', '.join(model.sensors)}, but has "
            f"{', '.join(map(str, times)) or 'none'}."
        )
    return {channel: as_times(f"times[{channel!r}]", times[channel]) for channel in model.sensors}


def _require_readable(times: dict[str, np.ndarray], rate: float, time_scale: float) -> None:
    """Check that a fit can follow the body from reading to reading."""
    intervals = [np.median(np.diff(t)) for t in times.values() if len(t) > 1]
    turn = rate * time_scale * min(intervals, default=0.0)
    if turn > FASTEST:
        raise ValueError(
            f"Argument `limits` must not let the body turn by more than {FASTEST:.3g} rad from "
            f"reading to reading, which no fit can follow, but its `rate` is {turn:.3g} rad for an "
            "interval of `times`: rates are in rad/s, and times in s."
        )


def _states(R0: Any, count: int) -> InitialStates:
    R = np.eye(3) if R0 is None else np.asarray(R0, float)
    if R.shape not in ((3, 3), (count, 3, 3)):
        raise ValueError(
            f"Argument `R0` must have shape (3, 3) or ({count}, 3, 3), but its shape is {R.shape}."
        )
    dtype = jax.dtypes.canonicalize_dtype(float)
    R = np.broadcast_to(R, (count, 3, 3)).astype(dtype)
    states = InitialStates(R, np.zeros((count, 3), dtype))
    require_rotations("R0", states)
    return states


def _require_limits(model: Model, limits: Limits, free: Free) -> None:
    """Check that limits and free leaves go with a model."""
    has_gyroscope = any(isinstance(sensor, Gyroscope) for sensor in model.sensors.values())
    if limits.saturation is not None and not has_gyroscope:
        raise ValueError(
            "Argument `saturation` of the limits must be None where the model has no `Gyroscope`."
        )
    if limits.travel is not None and model.gravity is None:
        raise ValueError(
            "Argument `travel` of the limits must be None where the model has no `gravity`, with "
            "which the centre of mass moves."
        )
    late = {
        f"{channel}.time_offset"
        for channel, sensor in model.sensors.items()
        if time_offset_of(sensor) is not None
    } | {"rotor_delay"}
    for leaf in free.leaves:
        if leaf in late:
            raise ValueError(
                f"Argument `free` must not choose `{leaf}`: a plan takes the clocks as known."
            )


def _draw_models(
    model: Model, free: Free, priors: tuple[Prior, ...], draws: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Values of the free leaves (1 + draws, p), and what is known at each (1 + draws, p, p)."""

    def table(thetas: np.ndarray) -> np.ndarray:
        return np.concatenate([prior.rows(model, free, thetas) for prior in priors], axis=1)

    thetas = free.theta[None]
    if priors and draws:
        drawn = np.tile(free.theta, (CANDIDATES * draws, 1))
        missing = errors = random.normal(size=table(drawn).shape[:2])
        limit = np.where(np.isfinite(free.max_step), LARGEST_CHANGE, np.inf)
        # Newton's steps to the leaves where the priors have these errors.
        for _ in range(STEPS_OF_DRAW):
            rows = table(drawn)
            missing = errors - rows[..., -1]
            steps = np.einsum("dpn,dn->dp", np.linalg.pinv(rows[..., :-1], 1e-9), missing)
            steps /= np.maximum(1, np.max(abs(steps) / limit, axis=1, keepdims=True))
            drawn = drawn + steps
        # No body has the errors that are still missing then, as for sides of a triangle.
        order = np.argsort(np.max(abs(missing), axis=1) > IMPOSSIBLE, kind="stable")
        thetas = np.concatenate([thetas, drawn[order[:draws]]])
    return thetas, _known(priors, model, free, thetas)


def _known(priors: tuple[Prior, ...], model: Model, free: Free, thetas: np.ndarray) -> np.ndarray:
    """The information (n, p, p) of priors at values (n, p) of the free leaves."""
    known = np.zeros((*thetas.shape, thetas.shape[1]))
    for prior in priors:
        rows = prior.rows(model, free, thetas)[..., :-1]
        known += np.swapaxes(rows, 1, 2) @ rows
    return known


def _goal(
    model: Model,
    free: Free,
    criterion: Criterion,
    quantity: Quantity | None,
    thetas: np.ndarray,
    directions: Directions,
) -> Goal:
    """What is to be known well.

    Raises
    ------
    ValueError
        If no experiment shows a number.
    """
    basis = directions.seen
    if not basis.shape[1]:
        raise ValueError(
            "Argument `limits` must allow an experiment that shows something of what is free, but "
            "none does: let the body start with a rate, or be moved by commands."
        )
    if quantity is None:
        of_seen = directions.coordinates
        return Goal(criterion, np.broadcast_to(of_seen, (len(thetas), *of_seen.shape)), basis)
    _, jacobians = linearise_quantity(quantity, model, free, thetas)
    if not np.all(np.isfinite(jacobians)):
        raise ValueError("Argument `quantity` must be finite, with its derivative, but it is not.")
    lost = np.linalg.norm(jacobians[0] @ directions.hidden, axis=1)
    size = np.linalg.norm(jacobians[0] / directions.scale, axis=1)
    if np.any(size == 0):
        raise ValueError("Argument `quantity` must depend on what is free, but a number does not.")
    for number in np.flatnonzero(lost > 1e-4 * size):
        raise ValueError(
            "Argument `quantity` must be what an experiment within the limits can show, but none "
            f"shows its number {number}. Of a body on which nothing known acts only ratios can be "
            "known, such as moments over the trace of the inertia."
        )
    return Goal(criterion, jacobians, basis)


def _uses(space: Space, best: Evaluated) -> Iterator[LimitUse]:
    """How much of each limit is taken."""
    limits, commands, rates = space.limits, space.commands, best.manoeuvres[:, :3]
    yield from space.uses_along(best)
    initial = limits.largest_initial_rate
    if 0 < initial < limits.rate:
        fastest = np.max(np.linalg.norm(rates, axis=1))
        yield LimitUse("initial rate", "rad/s", float(fastest), initial)
    if commands is None:
        return
    values, knots = space.at_knots(best.manoeuvres), space.experiment.grid.knots
    slopes = np.max(abs(np.diff(values, axis=1)), axis=(0, 1)) / (knots[1] - knots[0])
    for k, name in enumerate(commands.names):
        lowest, highest = float(values[:, :, k].min()), float(values[:, :, k].max())
        lower, upper = float(commands.lower[k]), float(commands.upper[k])
        if lower == -upper:
            yield LimitUse(name, commands.unit, max(-lowest, highest), upper)
        else:
            yield LimitUse(f"highest of {name}", commands.unit, highest, upper)
            yield LimitUse(f"lowest of {name}", commands.unit, lowest, lower, is_lowest=True)
        if np.isfinite(commands.slope[k]):
            unit = f"{commands.unit}²" if commands.unit == "rad/s" else f"{commands.unit}/s"
            change, limit = float(slopes[k]), float(commands.slope[k])
            yield LimitUse(f"change of {name}", unit, change, limit)
