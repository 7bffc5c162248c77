"""An experiment before it is done, for `lgvi simulate` and `lgvi plan`."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .experiment import add_model, free_function
from .folder import keep_programs
from .script import Script, call, say
from .settings import Settings, SettingsError, parse_names, parse_numbers, parse_sigma

DEFAULT_SIGMA = {"attitude": 1e-3, "angular_velocity": 1e-2}


def start_experiment(
    moments: str,
    rates: Sequence[str],
    seconds: float,
    rate: float,
    sigma: Sequence[str],
    cache: bool,
    free: Sequence[str] = (),
) -> Script:
    """Lines that make the model, the times and the initial states."""
    numbers = parse_sigma(sigma) or DEFAULT_SIGMA
    for quantity in numbers:
        if quantity not in ("attitude", "angular_velocity"):
            raise SettingsError(f"--sigma must be of attitude or angular_velocity, not {quantity}")
    if not (0 < seconds < math.inf and 0 < rate < math.inf and seconds * rate >= 1):
        raise SettingsError("--seconds and --rate must be above 0, and give two samples at least")
    principal = _three("--moments", moments)
    omega = [_three("--rates", words) for words in rates]
    script = Script()
    script.start()
    if cache:
        keep_programs()
    add_model(script, list(numbers), Settings(free=list(free), moments=principal), numbers)
    script.add(f"times = np.arange({round(seconds * rate) + 1}) / {rate!r}")
    script.add(f"states = identification.InitialStates.from_rates({omega!r})")
    return script


def _three(option: str, text: str) -> list[float]:
    numbers = parse_numbers(option, text)
    if len(numbers) != 3:
        raise SettingsError(f"{option} must be three numbers such as 1,2,2.8, but is {text!r}")
    return numbers


def run_simulate(output: str, *, seed: int, python: bool, cache: bool, **experiment: Any) -> None:
    """Simulate, and write what the sensors read: a file for each trajectory."""
    path, count = Path(output), len(experiment["rates"])
    if path.suffix not in (".csv", ".parquet"):
        raise SettingsError(f"FILE must end with .csv or .parquet, but is {output!r}")
    script = start_experiment(cache=cache, **experiment)
    with say("simulating"):
        key = f"key=jax.random.key({seed!r})"
        script.add(f"recordings = identification.simulate_recordings(model, times, states, {key})")
    names = [path.with_stem(f"{path.stem}-{i}") for i in range(count)] if count > 1 else [path]
    for i, name in enumerate(names):
        script.add(f"lgvi.logs.from_recordings(recordings)[{i}].write({str(name)!r})")
        print(f"lgvi: wrote {name}", file=sys.stderr)
    if python:
        print(script, end="")


def run_plan(
    output: str | None, *, free: Sequence[str], python: bool, cache: bool, **experiment: Any
) -> None:
    """Print the standard errors that an experiment would give."""
    settings = Settings(free=parse_names(free))
    script = start_experiment(cache=cache, free=settings.free, **experiment)
    arguments = ["model", "times", "states", free_function(list(script["model"].sensors), settings)]
    with say("differentiating the motion"):
        script.add(call("plan = identification.identifiability", *filter(None, arguments)))
    if output is not None:
        script.add(f"plan.to_html({output!r})")
    print(script if python else script["plan"], end="" if python else "\n")
