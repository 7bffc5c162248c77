"""The planned experiments keep what they promise, as their page shows."""

import re

import numpy as np
import plan_experiment
import pytest

from .pages import assert_page_shows


def errors_of(text):
    """The errors of the fit, in standard errors of the plan."""
    found = re.search(r"is off by (.*) of the standard errors", text)
    assert found, text
    return np.array(found[1].split(","), float)


@pytest.mark.slow
def test_planned_throws_keep_what_they_promise(output, tmp_path):
    picture = tmp_path / "throws.png"
    text = output(plan_experiment, "--plot", picture)
    assert_page_shows("plan_experiment", text)
    assert np.all(abs(errors_of(text)) < 4)
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("case", ["wheels", "drone"])
def test_planned_commands_keep_what_they_promise(case, output):
    text = output(plan_experiment, case)
    assert "which binds" in text
    assert np.all(abs(errors_of(text)) < 4)
