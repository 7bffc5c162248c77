"""Bad arguments of examples."""

import sys

import pytest


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
