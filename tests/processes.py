"""Modules that are programs of their own, as they set what JAX reads when it starts."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def run_module(name: str, *arguments: str, **variables: str) -> tuple[Any, str]:
    """The JSON in the last line that a module prints, and what it writes to the error stream.

    `variables` are added to the environment.
    """
    done = subprocess.run(
        [sys.executable, "-m", name, *arguments],
        cwd=ROOT,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr
