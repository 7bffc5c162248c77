"""The start of a fit, and other starts, which tell whether its minimum is the right one."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from ...modules.body import PhysicalRigidBody
from ...modules.known_axes import KnownAxesRigidBody
from ..model.free_leaves import Free, bodies_in, inertias_and_derivatives, ravel
from ..model.states import InitialStates
from ..segments.levels import Level
from ..solver.linearise import unobservable_scale_direction
from ..start.guess import guess_with_trials
from .problem import Problem

MOST_POWERS = 9  # powers of ten that are tried on the inertia of the start


def first_states(
    problem: Problem,
    level: Level,
    speeds: Sequence[np.ndarray],
    theta: np.ndarray,
    *,
    from_readings: bool = False,
) -> tuple[InitialStates, bool]:
    """States at the start of the shortest windows: the starts of the problem, else from readings.

    And whether states were tried, with the values `theta` of the free leaves, as the readings do
    not determine them. `from_readings` leaves out the starts of a configuration whose readings tell
    how the body turns.
    """
    states_of_parts = [
        _first_states(problem, level, k, speeds[k], theta, from_readings)
        for k in range(len(problem.configurations))
    ]
    most = max(own.shape[1] for _, own, _ in states_of_parts)  # padding is not used
    states = [
        _with_own(states, np.pad(own, ((0, 0), (0, most - own.shape[1]))))
        for states, own, _ in states_of_parts
    ]
    tried = any(part_tried for _, _, part_tried in states_of_parts)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *states), tried


def _with_own(states: InitialStates, own: np.ndarray) -> InitialStates:
    """States with their own numbers (windows, m), or None if m is zero."""
    return replace(states, own=own if own.shape[1] else None)


def _first_states(
    problem: Problem,
    level: Level,
    k: int,
    speeds: np.ndarray,
    theta: np.ndarray,
    from_readings: bool,
) -> tuple[InitialStates, np.ndarray, bool]:
    """States of the windows of one configuration, own numbers, and whether states were tried."""
    configuration, windows = problem.configurations[k], level.windows[k]
    model, recordings = configuration.model, configuration.recordings
    states, trials = guess_with_trials(model, recordings, windows, speeds)
    told = bool(np.any(trials.told))
    start = None if from_readings and told else problem.starts[k]
    if start is None and not told:
        where = f" of the part {configuration.name!r}" if configuration.name else ""
        channels = " and ".join(f"`{channel}`" for channel in model.sensors)
        raise ValueError(
            f"Argument `model`{where} must have a sensor that tells how the body turns, such as of "
            f"attitudes, rates or a direction, but has {channels} alone: add one, or give initial "
            "states to start from."
        )
    own = np.tile(configuration.own_start, (len(windows), 1)).astype(states.omega.dtype)
    if states.own is not None:
        own[:, configuration.is_state] = states.own
    states = replace(states, own=None)
    if trials.any:

        def costs(states: InitialStates) -> np.ndarray:
            return problem.costs(level, k, theta, _with_own(states, own))

        states = trials.choose(costs, states)
    if start is not None:
        trajectories, first = np.unique(level.chains[k].trajectory, return_index=True)
        start = start.at(trajectories)
        states = states.put(first, replace(start, own=None))
        if start.own is not None:
            own[np.ix_(first, configuration.is_state)] = np.asarray(start.own)
    return states, own, trials.any


def first_estimate(problem: Problem, level: Level, states: InitialStates) -> np.ndarray:
    """The start; if torques act, with inertias times the power of ten that fits best."""
    free = problem.free
    if not free.scale_direction.any() or all(
        unobservable_scale_direction(part.model, part.selected, part.recordings.quantities).any()
        for part in problem.configurations
    ):
        return free.theta
    costs = {}
    for power in sorted(range(-MOST_POWERS, MOST_POWERS + 1), key=abs):
        theta = free.theta + power * np.log(10) * free.scale_direction
        if np.all((free.lower <= theta) & (theta <= free.upper)):
            costs[power] = problem.cost(level, theta, states), theta
    least = min(costs, key=lambda power: costs[power][0])
    return costs[least if costs[least][0] < 0.9 * costs[0][0] else 0][1]


def other_estimates(parameters: Any, free: Free, theta: np.ndarray) -> list[np.ndarray]:
    """Two sets of inertias far from those of an estimate; the estimate if no inertia is free.

    One set has the principal moments about other axes; the other set is long where the estimate is
    flat.
    """
    if not free.scale_direction.any():
        return [theta]
    inertias, _ = inertias_and_derivatives(parameters, free._replace(theta=theta))
    bodies, estimates = bodies_in(parameters), []
    for change in (lambda d: 0.9 * np.roll(d, 1), lambda d: -0.5 * d):
        start = theta.copy()
        for body, J in zip(free.bodies, inertias, strict=True):
            if type(bodies[body.position]) is KnownAxesRigidBody:
                second = theta[body.at]
                turned = np.roll(second, 1) + 0.5 * (np.arange(len(second)) == 0)
                flat = 1.5 * np.mean(second) - 0.5 * second
                start[body.at] = flat if estimates else turned
            if type(bodies[body.position]) is not PhysicalRigidBody:
                continue
            moments, axes = np.linalg.eigh(J)
            moments = np.mean(moments) + change(moments - np.mean(moments))
            other = PhysicalRigidBody.from_inertia((axes * moments) @ axes.T)
            start[body.at] = ravel(jax.tree.map(np.asarray, other))
        estimates.append(np.clip(start, free.lower, free.upper))
    return estimates
