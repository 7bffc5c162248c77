"""Sensitive motions that get lost in long windows are found again."""

import jax
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, simulate_recordings
from lgvi.identification.least_squares.levenberg_marquardt import Point
from lgvi.identification.lost import LOST, recover
from lgvi.identification.model.configuration import Configuration
from lgvi.identification.model.selection import body_of, select_free_leaves
from lgvi.identification.problem import FitProblem
from lgvi.identification.windows import group
from lgvi.identification.windows.level import whole_level

COUNT, STEPS, SENSITIVE = 12, 600, 3


@pytest.mark.slow
def test_a_motion_that_gets_lost_is_fitted_again_and_others_are_left(monkeypatch):
    body = lgvi.PhysicalRigidBody.from_principal_moments([0.2, 0.35, 0.45])
    model, t = Model(body, lgvi.AttitudeSensor(1e-3)), np.arange(STEPS) * 0.1
    omega = np.tile([0.1, 0.2, 1.0], (COUNT, 1))
    omega[SENSITIVE] = 1e-3, 1.2, 1e-3  # about the middle axis
    states = InitialStates.from_rates(omega)
    recordings = simulate_recordings(model, t, states, key=jax.random.key(0))
    selected = select_free_leaves(model, body_of, ())
    configuration = Configuration("", recordings, model, None, selected.selected)
    integrator = lgvi.MoserVeselovIntegrator(0.1, order=6, throw=False)
    problem = FitProblem(model, selected, [configuration], [integrator])
    omega[SENSITIVE] += [2e-4, 0, -2e-4]
    start = InitialStates.from_rates(omega)
    point = Point(selected.theta, start, scale=np.zeros(6), damping=1e-3)

    def about(states):
        level = whole_level([configuration], [np.full(COUNT, 0.1)])
        return level, problem.linearise(level, selected.theta, states)

    level, few = about(start)
    assert recover(problem, level, point, few) is None  # all are simulated at once anyway
    monkeypatch.setattr(group, "SMALL", 0)
    level, found = about(start)
    assert found.costs[SENSITIVE] > LOST * np.median(found.costs)
    recovered = recover(problem, level, point, found)
    assert recovered is not None
    level, again = about(recovered)
    assert again.costs[SENSITIVE] == pytest.approx(3 * STEPS, rel=0.2)
    others = np.arange(COUNT) != SENSITIVE
    np.testing.assert_array_equal(again.costs[others], found.costs[others])
    assert recover(problem, level, point._replace(states=recovered), again) is None
