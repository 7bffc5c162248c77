"""Three recorded tosses and what is identified from them."""

import numpy as np
import pytest

import lgvi
from lgvi.identification import Model, identify
from lgvi.identification.windows import layout

from .recorded import SIGMA_R, trajectories

STEPS, READINGS = 128, 64  # of the tosses, with the padding


@pytest.fixture
def few_sizes(request, monkeypatch):
    """Small problems are padded to the size of the tosses, and share the programs of these.

    With `--optimised` they have sizes of their own, as for a user.
    """
    if request.config.getoption("--optimised"):
        return
    size_of = layout._size

    def at_least(*arguments, **options):
        steps, *readings = size_of(*arguments, **options)
        return [max(steps, STEPS), *(size and max(size, READINGS) for size in readings)]

    monkeypatch.setattr(layout, "_size", at_least)


@pytest.fixture(scope="session")
def tosses():
    return trajectories(3)


@pytest.fixture(scope="session")
def estimate(tosses):
    body = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
    return identify(Model(body, lgvi.AttitudeSensor(SIGMA_R)), tosses)
