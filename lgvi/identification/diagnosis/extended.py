"""The problem of a fit with more unknowns: the numbers of suspects, which are zero."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from ...modules.sensors.base import AbstractSensor
from ..compilation import compiled
from ..data.recordings import Recordings
from ..data.samples import Samples
from ..least_squares.linearise import Linearised
from ..model.configuration import Configuration
from ..model.free import Free
from ..model.model import Model
from ..model.states import InitialStates
from ..problem import FitProblem
from ..simulated import Simulated
from ..windows.level import whole_level
from ..windows.measured import largest_rates
from ..windows.step_size import choose_method, first_steps
from .left_out import LeftOut

TURN_OF_STEP = 0.05  # rad


class _Extended(eqx.Module):
    """The function of parameters, and the numbers of each suspect, that gives a model with these.

    `function` is None where the parameters are the model.
    """

    function: Any = eqx.field(static=True)
    suspects: tuple[LeftOut, ...] = eqx.field(static=True)
    has_rotor: bool = eqx.field(static=True)

    def __call__(self, both: tuple[Any, tuple[Array, ...]]) -> Model:
        parameters, numbers = both
        model = parameters if self.function is None else self.function(parameters)
        for suspect, each in zip(self.suspects, numbers, strict=True):
            if self.has_rotor or not suspect.is_of_rotor:
                model = suspect.add(model, each)
        return model


def linearise_with(
    suspects: tuple[LeftOut, ...],
    problem: FitProblem,
    longest_steps: Sequence[np.ndarray],
    states: InitialStates,
    residuals: Sequence[dict[str, np.ndarray]],
    unobservable: np.ndarray,
) -> Linearised | None:
    """A problem in its free leaves and in the numbers of suspects, about the estimate.

    With a method that suits all suspects, and recordings that leave the same residuals with
    it. None, if the leaves that are a trajectory's own cannot be found again, or the estimate
    cannot be simulated so.

    Parameters
    ----------
    suspects
        The suspects.
    problem, longest_steps, states
        A problem at its minimum, with the estimate in `problem.free`; the longest steps, s, of each
        configuration, and the states of all trajectories.
    residuals
        What the minimum leaves of each channel, of each configuration.
    unobservable
        Direction of the free leaves that is not observable (p,), or zeros.
    """
    free, dtype = problem.free, jax.dtypes.canonicalize_dtype(float)
    numbers = tuple(jax.device_put(np.zeros(suspect.number, dtype)) for suspect in suspects)
    parameters = problem.parameters, numbers
    extended = _extended(free, [number.size for number in numbers])
    configurations, methods, steps = [], [], []
    start = 0
    for each, method, longest in zip(
        problem.configurations, problem.methods, longest_steps, strict=True
    ):
        function = _Extended(each.function, suspects, each.recordings.rotor_momentum is not None)
        model = eqx.filter_jit(function)(parameters)
        given = each.name, each.recordings, function, model, parameters, extended
        configuration = Configuration.of_model(*given)
        if each.own is not None:
            own = _found_again(each.own, configuration.model)
            if own is None:
                return None
            configuration = configuration._replace(own=own)
        of_part = states.at(slice(start, start + len(each.recordings)))
        start += len(each.recordings)
        speeds = largest_rates(each.model, each.recordings, of_part)
        chosen = choose_method(configuration.model, each.recordings, None)
        step = first_steps(None, speeds, TURN_OF_STEP)
        configurations.append(configuration)
        methods.append(chosen)
        steps.append(np.minimum(step, longest) if method.order == chosen.order else step)
    found = replace(
        problem,
        parameters=parameters,
        free=extended,
        configurations=configurations,
        methods=methods,
        prior=[prior._replace(function=_OfFirst(prior.function)) for prior in problem.prior],
    )
    level = whole_level(configurations, steps)
    simulated = Simulated(found, level, extended.theta, states, None)
    predicted = [simulated.of_configuration(k, "predicted") for k in range(len(configurations))]
    if not all(np.isfinite(values).all() for each in predicted for values in each.values()):
        return None
    found.configurations = [
        each._replace(recordings=_with_residuals(each, *of_part))
        for each, *of_part in zip(configurations, predicted, residuals, strict=True)
    ]
    level = whole_level(found.configurations, steps)
    linearised = found.linearise(level, extended.theta, states)
    if not np.isfinite(linearised.cost):
        return None
    direction = np.pad(unobservable, (0, len(extended.theta) - len(free.theta)))
    return linearised._replace(system=linearised.system.without(direction))


class _OfFirst(eqx.Module):
    """A function of the parameters, where these are the first of a pair."""

    function: Any = eqx.field(static=True)

    def __call__(self, both: tuple[Any, Any]) -> Any:
        return self.function(both[0])


def _extended(free: Free, numbers: Sequence[int]) -> Free:
    """The free leaves, and those of suspects, which are zero."""
    count = sum(numbers)

    def with_(values: np.ndarray, of_suspects: float) -> np.ndarray:
        return np.concatenate([values, np.full(count, of_suspects)])

    return free._replace(
        theta=with_(free.theta, 0.0),
        lower=with_(free.lower, -np.inf),
        upper=with_(free.upper, np.inf),
        max_step=with_(free.max_step, np.inf),
        scale_direction=with_(free.scale_direction, 0.0),
        selected=(free.selected, (True,) * len(numbers)),
    )


def _found_again(own: Any, model: Any) -> Any:
    """Leaves of a trajectory's own, by their names, in a model with suspects; None if not all."""
    wanted = {path for path, chosen in jax.tree_util.tree_leaves_with_path(own) if chosen}
    found = jax.tree_util.tree_map_with_path(lambda path, leaf: path in wanted, model)
    return found if sum(jax.tree.leaves(found)) == len(wanted) else None


def _with_residuals(
    configuration: Configuration,
    predicted: dict[str, np.ndarray],
    residuals: dict[str, np.ndarray],
) -> Recordings:
    """Recordings whose readings are predictions disturbed by residuals."""
    recordings, sensors = configuration.recordings, configuration.model.sensors
    dtype = jax.dtypes.canonicalize_dtype(float)

    def disturbed(channel: str) -> np.ndarray:
        count = len(predicted[channel])
        if not count:
            return predicted[channel]
        # Lengths are powers of two, so that one program serves many.
        index = np.arange(2 ** (count - 1).bit_length()) % count
        both = (each[channel][index].astype(dtype) for each in (predicted, residuals))
        return np.asarray(_disturbed(sensors[channel], *both, few=True), float)[:count]

    channels = {
        channel: Samples(samples.times, disturbed(channel), samples.count)
        for channel, samples in recordings.channels.items()
    }
    return replace(recordings, channels=type(recordings.channels)(channels))


@compiled("the noise of a sensor")
def _disturbed(sensor: AbstractSensor, predicted: Array, residuals: Array) -> Array:
    return jax.vmap(sensor.add_noise)(predicted, residuals)
