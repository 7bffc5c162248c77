"""From logs to a result and a report, for `lgvi identify`."""

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from .experiment import FIRST_SIGMA, add_model, free_function, read_logs
from .folder import keep_programs
from .script import Script, call, say
from .settings import Settings, SettingsError

PAGE, RESULT, NUMBERS, TEXT = "report.html", "result.json", "numbers.csv", "report.txt"
RUN, SCRIPT = "run.toml", "run.py"
PACKAGES = "lgvi", "jax", "jaxlib", "equinox", "numpy", "scipy"
HOLDS = "the model holds"
FAILED, DOES_NOT_HOLD = 1, 3


def status_of(verdict: str, converged: bool) -> int:
    """The exit status: 0 the model holds, 1 the fit failed, 3 the model does not hold."""
    if not converged:
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
    if settings.mass is None and any(models.values()):
        raise SettingsError("--urdf and --mjcf need the mass, by --mass, in kg")
    script = Script()
    script.start()
    if cache:
        keep_programs()
    read_logs(script, settings)
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
        text = str(estimate) + "\n" + (f"\nhold-out: {validation}\n" if validation else "")
    for kind, path in models.items():
        if path is not None:
            arguments = {"mass": settings.mass, "centre": settings.centre}
            script.add(call("properties = estimate.mass_properties", **arguments))
            script.add(f"open({path!r}, 'w').write(properties.to_{kind}())")
    script.lines.append("estimate.report()")
    verdict = estimate.verdict
    if output is not None:
        with say(f"writing {Path(output) / PAGE}"):
            _write(script, settings, Path(output), text, validation)
    if python:
        print(script, end="")
    elif as_json:
        print(_json(estimate, validation))
    else:
        print(text, end="")
    return status_of(verdict, estimate.converged)


def _fit(script: Script, settings: Settings, fitted: str) -> None:
    """Lines that fit; with the residuals of a first fit as noise, where none is told."""
    channels = list(script["recordings"].channels)
    sigma = dict(settings.sigma)
    sigma |= {
        channel: settings.sensors[channel]["sigma"]
        for channel in channels
        if "sigma" in settings.sensors.get(channel, {})
    }
    told = set(channels) <= set(sigma)
    arguments = ["model", fitted, free_function(channels, settings)]
    code = call(
        "estimate = identification.identify", *filter(None, arguments), errors=settings.errors
    )
    with say(f"fitting {script[fitted]}"):
        add_model(script, settings, {**FIRST_SIGMA, **sigma})
        script.add(code)
    if told:
        return
    residuals = {
        channel: float(f"{np.sqrt(np.mean(rms**2)):.3g}")
        for channel, rms in script["estimate"].residual_rms.items()
    }
    if not script["estimate"].converged or not all(residuals.values()):
        return
    with say("fitting with the residuals as noise"):
        script.add("# The noise of each sensor is the residual of the fit before.")
        add_model(script, settings, {**residuals, **sigma})
        script.add(code)


def _json(estimate: Any, validation: Any) -> str:
    result = estimate.as_dict()
    if validation is not None:
        result["hold_out"] = validation.as_dict()
    return json.dumps(result, indent=2, ensure_ascii=False)


def _write(script: Script, settings: Settings, folder: Path, text: str, validation: Any) -> None:
    from ..plotting.report import Run, write_report

    folder.mkdir(parents=True, exist_ok=True)
    estimate = script["estimate"]
    hashes = {path: _hash(Path(path)) for path in settings.logs}
    versions = {"python": platform.python_version(), **_versions()}
    header = [
        *(f"# {name} {number}" for name, number in versions.items()),
        *(f"# sha256 of {path}: {digest}" for path, digest in hashes.items()),
    ]
    config = "\n".join(header) + "\n" + settings.to_toml()
    (folder / RUN).write_text(config, "utf-8")
    (folder / SCRIPT).write_text("\n".join(header) + "\n" + str(script), "utf-8")
    (folder / TEXT).write_text(text, "utf-8")
    (folder / RESULT).write_text(_json(estimate, validation) + "\n", "utf-8")
    estimate.to_csv(folder / NUMBERS)
    run = Run(
        command=f"lgvi identify --config {shlex.quote(str(folder / RUN))}",
        python=str(script),
        versions=versions,
        logs=hashes,
    )
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


def _versions() -> dict[str, str]:
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
