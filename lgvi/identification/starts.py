"""Where a fit begins, and where others begin that tell whether its minimum is the right one."""

import jax
import numpy as np

from ..modules.body import PhysicalRigidBody
from .least_squares.linearise import unobservable_scale_direction
from .model.free import Free, inertia_and_derivative, ravel
from .model.model import Model
from .model.states import InitialStates
from .problem import FitProblem
from .windows.grid import Window
from .windows.initial_guess import choose_attitudes, find_unknown_attitudes, guess_states
from .windows.layout import Layout
from .windows.schedule import first_of_trajectories

MOST_POWERS = 9  # powers of ten that are tried on the inertia of the start


def first_states(
    problem: FitProblem,
    layout: Layout,
    windows: list[Window],
    speeds: np.ndarray,
    start: InitialStates | None,
) -> InitialStates:
    """States at the start of the shortest windows: from `start` if given, else from readings."""
    model, recordings = problem.model, problem.recordings
    states = guess_states(model, recordings, windows, speeds)
    unknown = find_unknown_attitudes(model, recordings, windows)
    if unknown.any():

        def costs(states: InitialStates) -> np.ndarray:
            return np.asarray(problem.linearise(layout, problem.free.theta, states).factors.cost)

        states = choose_attitudes(costs, states, unknown)
    if start is None:
        return states
    first = first_of_trajectories(windows)
    R, omega = states.R.copy(), states.omega.copy()
    R[first], omega[first] = np.asarray(start.R), np.asarray(start.omega)
    return InitialStates(R, omega)


def first_estimate(problem: FitProblem, layout: Layout, states: InitialStates) -> np.ndarray:
    """The start; if something acts, with the inertia times the power of ten that fits best."""
    free = problem.free
    if (
        not free.scale_direction.any()
        or unobservable_scale_direction(problem.model, free, problem.recordings).any()
    ):
        return free.theta
    found = {}
    for power in sorted(range(-MOST_POWERS, MOST_POWERS + 1), key=abs):
        theta = free.theta + power * np.log(10) * free.scale_direction
        if np.all((free.lower <= theta) & (theta <= free.upper)):
            found[power] = problem.linearise(layout, theta, states).cost, theta
    least = min(found, key=lambda power: found[power][0])
    return found[least if found[least][0] < 0.9 * found[0][0] else 0][1]


def other_estimates(model: Model, free: Free, theta: np.ndarray) -> list[np.ndarray]:
    """Two inertias far from that of an estimate; the estimate itself if the inertia is known.

    One has its principal moments about other axes, the other is long where that is flat.
    """
    if not free.scale_direction.any():
        return [theta]
    J, _ = inertia_and_derivative(model, free._replace(theta=theta))
    moments, axes = np.linalg.eigh(J)
    differences = moments - np.mean(moments)
    found = []
    for other in (0.9 * np.roll(differences, 1), -0.5 * differences):
        body = PhysicalRigidBody.from_inertia((axes * (np.mean(moments) + other)) @ axes.T)
        start = theta.copy()
        start[free.of_body] = ravel(jax.tree.map(np.asarray, body))
        found.append(np.clip(start, free.lower, free.upper))
    return found
