"""The experiment that tells most, or what an experiment would tell, for `lgvi plan`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from .experiment import free_function
from .limits import read_limits
from .script import Script, call, say
from .settings import Settings, SettingsError, parse_names, parse_numbers
from .simulate import parse_body, parse_rates, start_experiment


def run_plan(
    output: str | None,
    *,
    moments: str,
    sigma: Sequence[str],
    free: Sequence[str],
    rates: Sequence[str],
    seconds: float,
    rate: float,
    python: bool,
    cache: bool,
    **search: Any,
) -> None:
    """Print the experiment that tells most; with rates, what theirs would tell."""
    settings = replace(parse_body(moments, sigma), free=parse_names(free))
    for path in (output, search["csv"]):
        if path is not None and not Path(path).absolute().parent.is_dir():
            raise SettingsError(f"{path}: its folder is not there")
    start = partial(start_experiment, seconds=seconds, rate=rate, cache=cache)
    script = _tell(settings, rates, start, search) if rates else _search(settings, start, **search)
    script.lines.append("plan.report()")
    if not python:
        print(script["plan"])
    if output is not None:
        with say(f"writing {output}"):
            script.add(f"plan.to_html({output!r})")
    if python:
        print(script, end="")


def _tell(
    settings: Settings,
    rates: Sequence[str],
    start: Callable[[Settings], Script],
    search: dict[str, Any],
) -> Script:
    """Lines that say what the experiment with some rates would tell."""
    names = [name for name, value in search.items() if value is not None]
    if names:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in names)
        raise SettingsError(
            f"--rates and {options} must not be there together: --rates is an experiment of your "
            "own, and without it one is searched for"
        )
    states = parse_rates(rates)
    script = start(settings)
    script.add(states)
    arguments = "model", "times", "states", free_function(list(settings.sigma), settings)
    with say("differentiating the motion"):
        script.add(call("plan = identification.identifiability", *filter(None, arguments)))
    return script


def _search(
    settings: Settings,
    start: Callable[[Settings], Script],
    *,
    limits: str | None,
    csv: str | None,
    max_rate: float | None,
    throws: int | None,
    initial_rate: float | None,
    saturation: str | None,
    turn: float | None,
) -> Script:
    """Lines that search for the experiment that tells most."""
    options = {
        "rate": max_rate,
        "trajectories": throws,
        "initial_rate": initial_rate,
        "saturation": None if saturation is None else _saturation(saturation),
        "turn": turn,
    }
    limited = read_limits(limits, options)
    if "saturation" in limited.values and "angular_velocity" not in settings.sigma:
        raise SettingsError(
            f"{limited.names['saturation']} is of a gyroscope, and needs its noise by "
            "--sigma angular_velocity=NUMBER"
        )
    settings = replace(settings, **limited.of_model)
    script = start(settings)
    arguments = "model", "times", "limits", free_function(list(settings.sigma), settings)
    code = call("plan = identification.plan", *filter(None, arguments))
    with limited.named(), say("searching for the experiment that tells most"):
        limited.add_to(script)
        script.add(code)
    if csv is not None:
        script.add(f"plan.to_csv({csv!r})")
    return script


def _saturation(text: str) -> float | list[float]:
    numbers = parse_numbers("--saturation", text)
    if len(numbers) not in (1, 3):
        raise SettingsError(
            f"--saturation must be a number or three, such as 8,8,4, but is {text!r}"
        )
    return numbers[0] if len(numbers) == 1 else numbers
