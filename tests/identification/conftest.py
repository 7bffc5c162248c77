"""Three recorded tosses and what is identified from them."""

import numpy as np
import pytest

import lgvi
from lgvi.identification import Model, identify

from .recorded import SIGMA_R, trajectories


@pytest.fixture(scope="session")
def tosses():
    return trajectories(3)


@pytest.fixture(scope="session")
def estimate(tosses):
    body = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
    return identify(Model(body, lgvi.AttitudeSensor(SIGMA_R)), tosses)
