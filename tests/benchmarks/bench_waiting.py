"""What a user waits for before the library is fast: each in a new process, without any cache."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ..waiting import PARTS

ROOT = Path(__file__).parents[2]
# The most processor time in s of what is measured; where it is None there is no figure to reach.
WANTED = {
    "import": 0.4,
    "forward": 1.2,
    "gradient": 2.0,
    "batch gradient": 3.0,
    "force gradient": 5.0,
    "identify": 5.0,
    "report": None,
    "identify again": 0.2,
    "identify, one dropped": 0.5,
    "report of it": None,
    "identify, two more": 0.5,
    "identify with a rotor": 7.0,
}
EXAMPLES = {"fit_inertia": 8.0, "learned_torque": 25.0, "identify_real_attitudes": 15.0}


def run(*arguments):
    """What a process of Python writes, and its processor time in s."""
    # No settings of JAX and XLA; and a user's Python keeps the bytecode of what it has imported.
    left_out = "JAX_", "XLA_", "PYTHONDONTWRITEBYTECODE"
    kept = {k: v for k, v in os.environ.items() if not k.startswith(left_out)}
    before = os.times()
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=kept,
        capture_output=True,
        text=True,
        check=True,
    )
    after = os.times()
    seconds = after.children_user + after.children_system
    return done.stdout, seconds - before.children_user - before.children_system


@pytest.mark.parametrize("part", [part for part in PARTS if part != "eager"])
def test_waiting(part, line):
    text, _ = run("-m", "tests.waiting", part)
    found = json.loads(text.splitlines()[-1])
    # The import is that of a part that is not the first: the bytecode is there then.
    for name, wanted in WANTED.items():
        if name in found and (name != "import" or part == "identify"):
            seconds, programs = found[name]["seconds"], found[name].get("programs")
            text = f"{'wait for ' + name:42} {seconds:9.2f} s"
            text += "" if programs is None else f" {programs:4d} programs"
            line(text if wanted is None else f"{text}   <= {wanted:g} s")


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example(name, line):
    _, imported = run("-c", "import jax, equinox, optax")
    _, seconds = run(f"examples/{name}.py")
    label = f"wait for examples/{name}.py"
    line(f"{label:42} {seconds - imported:9.2f} s   <= {EXAMPLES[name]:g} s")
