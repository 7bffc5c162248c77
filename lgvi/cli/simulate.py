"""An experiment before it is done, for `lgvi simulate` and `lgvi plan`."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path

from .experiment import add_model
from .folder import keep_programs
from .script import Script, say
from .settings import Settings, SettingsError, parse_numbers, parse_sigma

DEFAULT_SIGMA = {"attitude": 1e-3, "angular_velocity": 1e-2}


def parse_body(moments: str, sigma: Sequence[str]) -> Settings:
    """The settings of a body, and of the noise of its sensors."""
    numbers = parse_sigma(sigma) or DEFAULT_SIGMA
    for quantity in numbers:
        if quantity not in DEFAULT_SIGMA:
            raise SettingsError(f"--sigma must be of attitude or angular_velocity, not {quantity}")
    return Settings(moments=_three("--moments", moments), sigma=numbers)


def parse_rates(rates: Sequence[str]) -> str:
    """The line that makes the initial `states`."""
    omega = [_three("--rates", words) for words in rates]
    return f"states = identification.InitialStates.from_rates({omega!r})"


def _three(option: str, text: str) -> list[float]:
    numbers = parse_numbers(option, text)
    if len(numbers) != 3:
        raise SettingsError(f"{option} must be three numbers such as 1,2,2.8, but is {text!r}")
    return numbers


def start_experiment(settings: Settings, seconds: float, rate: float, cache: bool) -> Script:
    """Lines that make the model and the times."""
    if not (0 < seconds < math.inf and 0 < rate < math.inf and seconds * rate >= 1):
        raise SettingsError("--seconds and --rate must be above 0, and give two samples at least")
    script = Script()
    script.start()
    if cache:
        keep_programs()
    add_model(script, list(settings.sigma), settings, settings.sigma)
    script.add(f"times = np.arange({round(seconds * rate) + 1}) / {rate!r}")
    return script


def run_simulate(
    output: str,
    *,
    moments: str,
    rates: Sequence[str],
    seconds: float,
    rate: float,
    sigma: Sequence[str],
    seed: int,
    python: bool,
    cache: bool,
) -> None:
    """Simulate, and write what the sensors read: a file for each trajectory."""
    path, count = Path(output), len(rates)
    if path.suffix not in (".csv", ".parquet"):
        raise SettingsError(f"FILE must end with .csv or .parquet, but is {output!r}")
    settings, states = parse_body(moments, sigma), parse_rates(rates)
    script = start_experiment(settings, seconds, rate, cache)
    script.add(states)
    with say("simulating"):
        key = f"key=jax.random.key({seed!r})"
        script.add(f"recordings = identification.simulate_recordings(model, times, states, {key})")
    names = [path.with_stem(f"{path.stem}-{i}") for i in range(count)] if count > 1 else [path]
    for i, name in enumerate(names):
        script.add(f"lgvi.logs.from_recordings(recordings)[{i}].write({str(name)!r})")
        print(f"lgvi: wrote {name}", file=sys.stderr)
    if python:
        print(script, end="")
