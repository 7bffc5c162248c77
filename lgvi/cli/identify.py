"""From logs to a result and a report, for `lgvi identify`."""

import hashlib
import json
import os
import shlex
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..logs import Log
from .experiment import FIRST_SIGMA, add_model, free_function, read_logs
from .folder import keep_programs
from .noise import measure_noise
from .script import Script, call, say
from .settings import Settings, SettingsError

PAGE, RESULT, NUMBERS, TEXT = "report.html", "result.json", "numbers.csv", "report.txt"
RUN, SCRIPT = "run.toml", "run.py"
HOLDS = "the model holds"
NOT_CONVERGED = "the model does not hold: the fit did not converge"
FAILED, DOES_NOT_HOLD = 1, 3  # exit statuses
MOST_APART = 1.3  # ratio of the weights of two sensors, before they are weighed by residuals
# Residuals over the noise that readings have, beyond which they are no noise: the model is wrong.
MOST_NOISE = 3.0


def status_of(verdict: str) -> int:
    """The exit status: 0 the model holds, 1 the fit failed, 3 the model does not hold."""
    if verdict == NOT_CONVERGED:
        return FAILED
    return 0 if verdict.startswith(HOLDS) else DOES_NOT_HOLD


def run_identify(
    settings: Settings,
    *,
    output: str | None,
    models: Mapping[str, str | None],
    as_json: bool,
    python: bool,
    cache: bool,
) -> int:
    """Identify, print and write the result; the exit status."""
    if not settings.logs:
        raise SettingsError("a log must be given: the path of a file")
    if settings.mass is None and any(models.values()):
        raise SettingsError("--urdf and --mjcf need the mass, by --mass, in kg")
    if output is not None:
        Path(output).mkdir(parents=True, exist_ok=True)
    for path in models.values():
        if path is not None and not Path(path).absolute().parent.is_dir():
            raise SettingsError(f"{path}: its folder is not there")
    hashes = {path: _hash(Path(path)) for path in settings.logs}
    if len(set(hashes.values())) < len(settings.logs):
        raise SettingsError("a log must be given once, but of these some have the same content")
    for path, digest in hashes.items():
        if settings.sha256.get(path, digest) != digest:
            warnings.warn(f"{path}: is not the file of the saved run, by its SHA-256", stacklevel=1)
    script = Script()
    script.start()
    if cache:
        keep_programs()
    flights = read_logs(script, settings)
    fitted = "recordings"
    if settings.hold_out is not None:
        script.add(f"fitted, kept_back = recordings.hold_out({settings.hold_out!r})")
        fitted = "fitted"
    _fit(script, settings, fitted)
    estimate = script["estimate"]
    validation = None
    if settings.hold_out is not None:
        with say("predicting what was kept back"):
            script.add("validation = estimate.validate(kept_back)")
        validation = script["validation"]
    with say("testing what the model leaves out"):
        text = _text(estimate, validation)
    verdict = estimate.verdict
    script.lines.append("estimate.report()")
    if not python:
        print(_json(estimate, validation) if as_json else text, end="\n" if as_json else "")
    for words in _what_to_try(estimate):
        print(f"lgvi: {words}", file=sys.stderr)
    try:
        _add_models(script, settings, models)
    finally:  # an inertia without a size is no model, but a result
        if output is not None:
            saved = replace(settings, sha256=hashes)
            with say(f"writing {Path(output) / PAGE}"):
                _write(script, saved, Path(output), text, validation, flights)
    if python:
        print(script, end="")
    return status_of(verdict)


def _fit(script: Script, settings: Settings, fitted: str) -> None:
    """Lines that fit; again with the residuals as noise, where the readings did not tell it."""
    channels = list(script["recordings"].channels)
    told = dict(settings.sigma)
    for channel in channels:
        if "sigma" in (arguments := settings.sensors.get(channel, {})):
            told[channel] = arguments["sigma"]
    measured = measure_noise(script[fitted])
    arguments = ["model", fitted, free_function(channels, settings)]
    options = {"errors": settings.errors, "check": settings.check}
    code = call("estimate = identification.identify", *filter(None, arguments), **options)
    with say(f"fitting {script[fitted]}"):
        if set(channels) & set(measured) - set(told):
            script.add("# The noise of a sensor is measured from how successive readings scatter.")
        add_model(script, channels, settings, {**FIRST_SIGMA, **measured, **told})
        script.add(code)
    residuals = {
        channel: float(np.sqrt(np.mean(np.square(size))))
        for channel, size in script["estimate"].residual_rms.items()
    }
    ratios = [residuals[c] / measured[c] for c in channels if c in measured and c not in told]
    unknown = [c for c in channels if c not in measured and c not in told]
    apart = MOST_APART * min(ratios, default=1) < max(ratios, default=1) < MOST_NOISE
    if not (unknown or apart) or not script["estimate"].converged or not min(residuals.values()):
        return
    with say("fitting with the residuals as noise"):
        script.add("# The noise of each sensor is the residual of the fit before.")
        rounded = {channel: float(f"{size:.3g}") for channel, size in residuals.items()}
        add_model(script, channels, settings, {**rounded, **told})
        script.add(code)


def _add_models(script: Script, settings: Settings, models: Mapping[str, str | None]) -> None:
    """Lines that write elements of models of a robot."""
    for kind, path in models.items():
        if path is not None:
            arguments = {"mass": settings.mass, "centre": settings.centre}
            script.add(call("properties = estimate.mass_properties", **arguments))
            script.add(f"pathlib.Path({path!r}).write_text(properties.to_{kind}(), 'utf-8')")


def _text(estimate: Any, validation: Any) -> str:
    """The report, with the hold-out, and what was read and assumed."""
    text = str(estimate)
    if validation is not None:
        text += f"\n\nhold-out: {validation}"
    lines = "\n".join(f"  {line}" for line in estimate.recordings.provenance)
    return f"{text}\n\nread and assumed:\n{lines}\n"


def _what_to_try(estimate: Any) -> Iterator[str]:
    """Options for the next run, by what the model leaves out."""
    from ..identification.diagnosis.momentum import NO_BODY
    from ..identification.diagnosis.suspects import LINEAR, QUADRATIC

    laws = {LINEAR: "damping", QUADRATIC: "drag"}
    for suspect in estimate.suspects[:1]:
        if suspect.is_certain and not estimate.mistakes:
            names = [str(laws.get(name, name)) for name in suspect.names]
            yield f"to allow for it, run again with --free {' or --free '.join(names)} as well"
    if any(words.startswith(NO_BODY) for words in estimate.reasons):
        yield (
            "to fit free flights alone, say when they are by --from and --to or --flights, or name "
            "the accelerometer by --map specific_force=..., which shows them"
        )


def _json(estimate: Any, validation: Any) -> str:
    result = estimate.as_dict()
    if validation is not None:
        result["hold_out"] = validation.as_dict()
    return json.dumps(result, indent=2, ensure_ascii=False)


def _write(
    script: Script,
    settings: Settings,
    folder: Path,
    text: str,
    validation: Any,
    flights: Sequence[tuple[Log, Any]],
) -> None:
    from ..plotting.report import Run, write_report

    estimate = script["estimate"]
    run = Run(
        command=f"lgvi identify --config {shlex.quote(str(folder / RUN))}",
        python=str(script),
        logs=settings.sha256,
        flights=flights,
    )
    header = "".join(f"# {name} {number}\n" for name, number in run.versions.items())
    hashes = "".join(f"# sha256 of {path!r}: {digest}\n" for path, digest in run.logs.items())

    def from_folder(path: str) -> str:
        try:
            path = os.path.relpath(path, folder)
        except ValueError:  # on another drive of Windows
            path = os.path.abspath(path)
        return Path(path).as_posix()

    (folder / RUN).write_text(header + settings.with_paths(from_folder).to_toml(), "utf-8")
    (folder / SCRIPT).write_text(header + hashes + str(script), "utf-8")
    (folder / TEXT).write_text(text, "utf-8")
    (folder / RESULT).write_text(_json(estimate, validation) + "\n", "utf-8")
    estimate.to_csv(folder / NUMBERS)
    write_report(estimate, folder / PAGE, run=run, validation=validation)


def _hash(path: Path) -> str:
    """SHA-256 of a file, or of the files of a folder."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        with open(file, "rb") as opened:
            while block := opened.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
