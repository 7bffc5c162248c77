"""Times of one run, and the table of their ratios at its end."""

import math
from time import perf_counter

import jax
import pytest

TIMES = pytest.StashKey[dict[str, float]]()
LINES = pytest.StashKey[list[str]]()


@pytest.fixture(autouse=True)
def usual_promotion():
    """The settings of the tests are stricter than the code that is compared here."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def once(request):
    """Whether each benchmark shall run but once, which shows that it runs."""
    return request.config.getoption("benchmark_disable")


@pytest.fixture
def clock(benchmark, request):
    """Time a function and keep the least time, per step, under a name."""

    def measure(name, run, steps, *arguments, rounds=15):
        benchmark.pedantic(
            lambda: jax.block_until_ready(run(*arguments)), rounds=rounds, warmup_rounds=1
        )
        if benchmark.disabled:  # it has run, which is all that was wanted
            return math.nan
        time = benchmark.stats.stats.min / steps
        request.config.stash.setdefault(TIMES, {})[name] = time
        return time

    return measure


@pytest.fixture
def compiled(request):
    """Compile a function and write down how long it took."""

    def compile_(name, function, *arguments):
        start = perf_counter()
        program = jax.jit(function).lower(*arguments).compile()
        request.config.stash.setdefault(TIMES, {})[f"compile {name}"] = perf_counter() - start
        return program

    return compile_


@pytest.fixture
def line(request):
    """Write a line under the table."""
    return request.config.stash.setdefault(LINES, []).append


# What is measured, against what, and how many times that it may take.
RATIOS = [
    ("free", "C", 1.5),
    ("free", "textbook", 1 / 200),
    ("torques, array dt", "C, torques", 2.5),
    ("value and gradient", "free", 3),
    ("value and gradient", "textbook gradient", 1 / 400),
    ("torques: gradient", "torques, array dt", 3),
    ("1000 bodies", "C", 1.2),
    ("1000 bodies: gradient", "1000 bodies", 4),
    ("pendulum: gradient", "pendulum", 5),
    ("pendulum, order 4: gradient", "pendulum, order 4", 5),
    ("pendulum, order 8: gradient", "pendulum, order 8", 5),
    ("gravity gradient: gradient", "gravity gradient", 5),
    ("controller: gradient", "controller", 5),
    ("rotors: gradient", "rotors", 5),
]
# The longest time of a step, in us; of 17 drifts there is none.
STEPS = {
    "step in a scan": 2.5,
    "pendulum": 4,
    "pendulum, order 4": 4,
    "pendulum, order 8": None,
    "gravity gradient": 4,
    "controller": 4,
    "rotors": 4,
}


def pytest_terminal_summary(terminalreporter, config):
    times, lines = config.stash.get(TIMES, {}), config.stash.get(LINES, [])
    write = terminalreporter.write_line
    if not times and not lines:
        return
    terminalreporter.section("ratios")
    write(f"{'':42} us per step    ratio   wanted")
    for name, other, most in RATIOS:
        if name in times and other in times:
            ratio = times[name] / times[other]
            ratio, wanted = (
                (f"{ratio:8.2f}", f"<= {most:g}")
                if most >= 1
                else (f"1/{1 / ratio:.0f}".rjust(8), f"<= 1/{1 / most:.0f}")
            )
            write(f"{name + ' / ' + other:42} {1e6 * times[name]:11.3f} {ratio}   {wanted}")
    for name, seconds in times.items():
        if name.startswith("compile"):
            of_law = any(name.startswith(f"compile {law}") for law in STEPS)
            wanted = "" if of_law else "            <= 3 s"
            write(f"{name:42} {seconds:9.1f} s{wanted}")
    for name, most in STEPS.items():
        if name in times:
            wanted = "" if most is None else f"            <= {most:g}"
            write(f"{name:42} {1e6 * times[name]:11.3f}{wanted}")
    for text in lines:
        write(text)
