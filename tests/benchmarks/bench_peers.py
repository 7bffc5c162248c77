"""Free motion beside what a user would take instead, in one run, and a picture of the energies.

A body that is spun about the middle axis turns over again and again, for 100 s and for 10^4 s, at
equal steps; and for 100 s at equal accuracy, by the largest step or tolerance of a ladder that
reaches it. With the picture: python -m tests.benchmarks.bench_peers docs/images/peers.png
"""

import sys
from collections.abc import Iterable
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

from .bench_work_precision import least_time
from .peers import MOMENTS, OMEGA0, Method, Motion, methods, missing_peers

SHORT, LONG = 100.0, 10_000.0  # s
PYTHON = "SciPy"  # too slow for the long run at small tolerances
GRADIENT = 10.0  # s
SAMPLES = 100
SHOWN = "lgvi, order 2", "MuJoCo, Euler", "MuJoCo, implicit", "MuJoCo, RK4"  # in the picture
PACKAGES = "lgvi", "jax", "mujoco", "mujoco-mjx", "brax", "bsk", "diffrax", "scipy"
ACCURACY = 1e-6  # rad, after 100 s
LADDER = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001), tuple(10.0**-k for k in range(5, 13))


class Errors(NamedTuple):
    """How far a motion is from the exact one, at most."""

    energy: np.ndarray  # (samples,), relative
    momentum: float  # in space, relative
    attitude: float  # rad


def measure_errors(motion: Motion, span: float) -> Errors:
    R, omega = motion
    momentum = omega * MOMENTS
    energy = np.sum(omega * momentum, axis=1)
    in_space = np.einsum("nij,nj->ni", R, momentum)
    body = lgvi.RigidBody(jnp.diag(jnp.asarray(MOMENTS)))
    times = np.linspace(0, span, len(R))
    exact, _ = lgvi.free_motion(body, np.eye(3), MOMENTS * OMEGA0, times)
    away = np.linalg.norm(R - np.asarray(exact), axis=(1, 2)) / (2 * np.sqrt(2))
    return Errors(
        energy / energy[0] - 1,
        _largest(np.linalg.norm(in_space - in_space[0], axis=1) / np.linalg.norm(in_space[0])),
        _largest(2 * np.arcsin(np.clip(away, 0, 1))),
    )


def _largest(x: np.ndarray) -> float:
    """The largest number; infinite where a motion is lost."""
    return float(np.max(np.where(np.isfinite(x), x, np.inf)))


def time_of(run: Any, repeat: int) -> float:
    """The least time of calls after the first one, s."""
    jax.block_until_ready(run())
    return least_time(run, repeat=repeat)


class Row(NamedTuple):
    """What was measured of a method."""

    method: Method
    short: Errors
    long: Errors | None
    seconds: float  # for a simulated second
    gradient: float | None  # value and gradient, for a simulated second


def measure(method: Method, span: float, long_span: float, repeat: int) -> Row:
    run = method.prepare(span, SAMPLES)
    short, seconds = measure_errors(run(), span), time_of(run, repeat) / span
    long = None
    if method.peer != PYTHON:
        long = measure_errors(method.prepare(long_span, SAMPLES)(), long_span)
    gradient = None
    if method.prepare_gradient is not None:
        time = min(GRADIENT, span)
        gradient = time_of(method.prepare_gradient(time), repeat) / time
    return Row(method, short, long, seconds, gradient)


def text_of(row: Row) -> str:
    def number(x: float | None, scale: float = 1.0) -> str:
        return f"{'-':>9}" if x is None else f"{scale * x:9.1e}"

    long = [None] * 3 if row.long is None else [_largest(abs(row.long.energy)), *row.long[1:]]
    cells = [_largest(abs(row.short.energy)), *row.short[1:], *long]
    times = f"{number(row.seconds, 1e6)} {number(row.gradient, 1e6)}"
    return f"{row.method!s:44} {' '.join(map(number, cells))} {times}"


def measure_all(chosen: Iterable[Method], times: tuple[float, float, int], write: Any) -> list[Row]:
    """Measure methods, and write a line for each."""
    names = [f"{name} {_version(name)}" for name in PACKAGES]
    write(", ".join(names))
    for peer in missing_peers():
        write(f"{peer} is not installed, and was not measured")
    write(f"{'':44} {f'after {SHORT:g} s':29} {f'after {LONG:g} s':29} us for 1 s of motion")
    heads = "energy", "momentum", "angle, rad"
    write(f"{'':44} {' '.join(f'{x:>9.9}' for x in (*heads, *heads, 'motion', 'gradient'))}")
    rows = []
    for method in chosen:
        rows.append(measure(method, *times))
        write(text_of(rows[-1]))
    return rows


def measure_at_equal_accuracy(ladder: Any, span: float, repeat: int, write: Any) -> None:
    """Times of each method at the first setting whose attitudes are accurate enough."""
    write(f"an attitude within {ACCURACY:g} rad after {span:g} s: us for 1 s of motion, gradient")
    families: dict[tuple[str, str], list[Method]] = {}
    for method in methods(*ladder):
        families.setdefault((method.peer, method.name), []).append(method)
    for (peer, name), settings in families.items():
        for method in settings:
            run = method.prepare(span, SAMPLES)
            if not measure_errors(run(), span).attitude <= ACCURACY:
                continue
            times = [time_of(run, repeat) / span]
            if method.prepare_gradient is not None:
                times.append(time_of(method.prepare_gradient(span), repeat) / span)
            write(f"{method!s:44} {' '.join(f'{1e6 * time:9.1f}' for time in times)}")
            break
        else:
            write(f"{f'{peer}, {name}':44} with no setting")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "is missing"


def plot_energies(rows: list[Row], file: str) -> None:
    """The error of the energy over time at the large step; others have one of these curves."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8, 3.2), layout="constrained")
    t = np.linspace(0, SHORT, SAMPLES + 1)
    step = max(row.method.setting for row in rows if not row.method.is_adaptive)
    for row in rows:
        name = f"{row.method.peer}, {row.method.name}"
        if name in SHOWN and row.method.setting == step:
            size = np.maximum(abs(row.short.energy), np.finfo(float).eps)
            size = np.where(np.isfinite(row.short.energy), size, np.nan)
            axis.semilogy(t[1:], size[1:], label=name)
    axis.set(xlabel="time (s)", ylabel="relative error of the energy", ylim=(1e-16, 1e2))
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(file, dpi=150)


def test_free_motion_beside_the_peers(line, once):
    if once:
        measure_all(methods([0.01], [1e-6]), (1.0, 2.0, 1), line)
        measure_at_equal_accuracy(([0.01], [1e-6]), 1.0, 1, line)
    else:
        measure_all(methods(), (SHORT, LONG, 3), line)
        measure_at_equal_accuracy(LADDER, SHORT, 3, line)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    write = partial(print, flush=True)
    plot_energies(measure_all(methods(), (SHORT, LONG, 3), write), sys.argv[1])
    measure_at_equal_accuracy(LADDER, SHORT, 3, write)
