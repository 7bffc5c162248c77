"""An experiment before it is done, for `lgvi simulate` and `lgvi plan`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .experiment import SENSORS, free_function
from .folder import keep_programs
from .script import Script, call, say
from .settings import Settings, SettingsError, parse_numbers, parse_pairs

DEFAULT_SIGMA = {"attitude": 1e-3, "angular_velocity": 1e-2}


def start_experiment(
    moments: str,
    rates: Sequence[str],
    seconds: float,
    rate: float,
    sigma: Sequence[str],
    cache: bool,
) -> Script:
    """Lines that make the model, the times and the initial states."""
    numbers = {
        quantity: parse_numbers("--sigma", value)[0]
        for quantity, value in parse_pairs("--sigma", sigma).items()
    } or DEFAULT_SIGMA
    for quantity in numbers:
        if quantity not in ("attitude", "angular_velocity"):
            raise SettingsError(f"--sigma must be of attitude or angular_velocity, not {quantity}")
    if not (seconds > 0 and rate > 0 and seconds * rate >= 1):
        raise SettingsError("--seconds and --rate must be above 0, and give two samples at least")
    principal = _three("--moments", moments)
    omega = [_three("--rates", words) for words in rates]
    script = Script()
    script.start()
    if cache:
        keep_programs()
    sensors = ", ".join(
        call(f"lgvi.{SENSORS[quantity][0]}", sigma=value) for quantity, value in numbers.items()
    )
    script.add(f"body = lgvi.PhysicalRigidBody.from_principal_moments({principal!r})")
    script.add(f"model = identification.Model(body, [{sensors}])")
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
    script = start_experiment(cache=cache, **experiment)
    with say("simulating"):
        key = f"key=jax.random.key({seed!r})"
        script.add(f"recordings = identification.simulate_recordings(model, times, states, {key})")
    path, count = Path(output), len(experiment["rates"])
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
    script = start_experiment(cache=cache, **experiment)
    settings = Settings(free=[part for word in free for part in word.split(",")])
    arguments = ["model", "times", "states", free_function(list(script["model"].sensors), settings)]
    with say("differentiating the motion"):
        script.add(call("plan = identification.identifiability", *filter(None, arguments)))
    if output is not None:
        script.add(f"plan.to_html({output!r})")
    print(script if python else script["plan"], end="" if python else "\n")
