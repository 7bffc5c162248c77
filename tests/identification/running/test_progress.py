"""What is shown while somebody waits."""

import re
import sys
from time import sleep
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identifiability,
    identify,
    identify_jointly,
    initial_states,
    simulate_recordings,
)
from lgvi.identification.diagnosis.suspects import ScoreTests
from lgvi.identification.estimate.estimate import contents_of
from lgvi.identification.fit.bootstrap import Bootstrap
from lgvi.identification.running import compilation
from lgvi.identification.running.compilation import compiled
from lgvi.identification.running.progress import Times, show_progress, times
from lgvi.identification.start import guess

ANY: Any = show_progress


@pytest.fixture
def written(monkeypatch, capsys):
    """What is written while a function runs, where somebody watches or not."""

    def of(function, watched=True):
        monkeypatch.setattr(sys.stderr, "isatty", lambda: watched)
        function()
        return capsys.readouterr().err

    before = times.set(Times(patience=0.05, interval=0.01, line=0.1))
    yield of
    times.reset(before)


def said(text):
    """What a bar says, one after another, without the time."""
    looks = [re.sub(r" \[.*", "", look).strip() for look in text.split("\r")]
    return list(dict.fromkeys(look for look in looks if look))


def fit(show):
    with show_progress("identify", show=show) as report:
        sleep(0.15)
        report.iteration(3.0, np.zeros(1))
        sleep(0.15)


def test_a_bar_stays_where_it_is_asked_for(written):
    text = written(lambda: fit(True), watched=False)
    assert re.search(r"identify \[00:0\d\]", text)
    assert re.search(r"identify: 1 iterations \[00:0\d, chi_square=3\]\s*$", text)


def test_where_somebody_watches_a_bar_comes_and_goes(written):
    text = written(lambda: fit(None))
    assert "identify: 1 iterations" in text
    assert text.endswith("\r")
    assert not text.split("\r")[-2].strip()


def test_elsewhere_there_is_a_line_now_and_then(written):
    lines = written(lambda: fit(None), watched=False).splitlines()
    assert lines[0] == "lgvi: ... 0 s, identify"
    assert lines[-1] == "lgvi: ... 0 s, identify: 1 iterations, chi_square=3"
    assert len(lines) <= 3


def test_nothing_is_written_where_nobody_wants_to_know(written):
    assert written(lambda: fit(False)) == ""


def test_what_follows_a_fit_does_not_show_its_iterations(written):
    def fit_and_report():
        with show_progress("identify", show=True) as report:
            report.iteration(3.0, np.zeros(1))
            sleep(0.15)
            with show_progress("report"):
                sleep(0.15)

    assert {"identify: 1 iterations", "identify, report"} <= set(said(written(fit_and_report)))


def test_what_is_quick_shows_nothing(written):
    @show_progress("report")
    def report():
        pass

    assert written(report) == ""


def test_anything_else_is_refused():
    with pytest.raises(TypeError, match="must be True, False or None, but is 'no'"):
        ANY("identify", show="no").__enter__()


def slow_to_compile():
    """A function whose tracing takes long, and which takes long itself."""

    @compiled("a sum")
    def added(x, y):
        sleep(0.15)
        return x + y

    return lambda: added(jnp.ones(()), jnp.ones(()))


def test_a_program_says_that_it_is_compiled_but_once(written):
    add = slow_to_compile()
    assert said(written(add))[-1] == "compiling a sum"
    assert "compiling" not in written(add)


def test_what_is_called_within_is_said_by_one_bar(written):
    add = slow_to_compile()

    @show_progress("report")
    def report():
        sleep(0.1)
        with show_progress("score tests"):
            add()
            sleep(0.1)
        sleep(0.1)

    compiling, tests = "report, score tests, compiling a sum", "report, score tests"
    assert [each for each in said(written(report)) if each != tests] == ["report", compiling]
    assert tests in said(written(report))


def test_what_is_called_within_a_silent_function_is_silent(written):
    add = slow_to_compile()

    def silent():
        with show_progress("identify", show=False):
            add()

    assert written(silent) == ""


def test_a_function_that_fails_leaves_no_bar(written):
    def fail():
        with show_progress("identify"), show_progress("fitting"):
            sleep(0.15)
            raise ZeroDivisionError

    def handled():
        with pytest.raises(ZeroDivisionError):
            fail()

    text = written(handled)
    assert said(text) == ["identify, fitting"]
    assert text.endswith("\r")
    assert said(written(lambda: fit(None)))[0] == "identify"


class StopError(Exception):
    """What is being done where a door is stopped."""


def stop():
    with show_progress() as shown:
        raise StopError(", ".join(shown.doing))


class Stopping:
    """What stops whoever looks at it."""

    def __getattr__(self, name):
        stop()


class Looked:
    @property
    def suspects(self):
        return ScoreTests(ANYTHING, [], ANYTHING, ANYTHING, 1.0).found


ANYTHING: Any = Stopping()
BODY = lgvi.PhysicalRigidBody.from_principal_moments([1.0, 2.0, 2.5])
MODEL = Model(BODY, lgvi.AttitudeSensor(1e-3))
T = 0.1 * np.arange(20)
STATES = InitialStates(jnp.eye(3)[None], jnp.array([[0.3, 1.0, 0.2]]))
STILL = Recordings.from_arrays(T, attitude=np.tile(np.eye(3), (20, 1, 1)))
PARTS: Any = {"one": (lambda body: Model(body, MODEL.sensors["attitude"]), STILL)}
DOORS = {
    "simulate_recordings": lambda: simulate_recordings(MODEL, T, STATES),
    "identifiability, simulate_recordings": lambda: identifiability(MODEL, T, STATES),
    "identify, fitting": lambda: identify(MODEL, STILL),
    "identify_jointly, fitting": lambda: identify_jointly(BODY, PARTS),
    "initial_states": lambda: initial_states(MODEL, STILL),
    "report, score tests": lambda: contents_of(cast(Any, Looked())),
    "bootstrap": lambda: Bootstrap(ANYTHING, [], ANYTHING, ANYTHING, 1.0).draws,
}


@pytest.mark.parametrize("door", DOORS)
def test_who_waits_is_told_which_function_it_is(door, monkeypatch):
    """Each is stopped at its first program, or where it first looks at anything."""
    monkeypatch.setattr(compilation, "show_program", stop)
    monkeypatch.setattr(guess, "guess_states", lambda *_: stop())
    with pytest.raises(StopError, match=f"^{door}$"):
        DOORS[door]()
