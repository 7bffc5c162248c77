"""What is shown while a fit goes on."""

import re
from time import sleep
from typing import Any

import numpy as np
import pytest

from lgvi.identification import progress
from lgvi.identification.progress import show_progress

ANY: Any = show_progress


@pytest.fixture
def shown(monkeypatch, capsys):
    """What is written while a fit compiles and then makes an iteration."""
    monkeypatch.setattr(progress, "INTERVAL", 0.01)
    monkeypatch.setattr(progress, "PATIENCE", 0.05)

    def of(show, watched=False):
        monkeypatch.setattr(progress, "_is_watched", lambda: watched)
        with show_progress(show) as report:
            sleep(0.3)
            report.iteration(3.0, np.zeros(1))
            sleep(0.3)
        return capsys.readouterr().err

    return of


def test_a_bar_tells_of_compiling_and_stays_where_it_is_asked_for(shown):
    text = shown(True)
    assert "compiling: 0 iterations" in text
    assert re.search(r"identify: 1 iterations \[00:0\d, chi_square=3\]\s*$", text)


def test_where_somebody_watches_a_bar_comes_and_goes(shown):
    text = shown(None, watched=True)
    assert "compiling" in text
    assert text.endswith("\r")
    assert not text.split("\r")[-2].strip()


@pytest.mark.parametrize("show", [False, None])
def test_nothing_is_written_otherwise(shown, show):
    assert shown(show, watched=show is False) == ""


def test_anything_else_is_refused():
    with pytest.raises(TypeError, match="must be True, False or None, but is 'no'"):
        ANY("no").__enter__()
