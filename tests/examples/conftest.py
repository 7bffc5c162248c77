"""Examples that run, and bad arguments of them."""

import sys

import jax
import pytest


@pytest.fixture
def output(monkeypatch, capsys):
    """What an example writes, run in this process, which has imported all it needs."""

    def of(example, *arguments):
        monkeypatch.setattr(sys, "argv", [example.__file__, *map(str, arguments)])
        # The settings of a user are laxer than those of the tests.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            example.main()
        return capsys.readouterr().out

    return of


@pytest.fixture
def refusal(monkeypatch, capsys):
    """What an example writes when it refuses its arguments: to stderr, with exit status 2."""

    def of(example, *arguments):
        monkeypatch.setattr(sys, "argv", [example.__file__, *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            example.main()
        assert stop.value.code == 2
        return capsys.readouterr().err

    return of
