"""Modules that are programs of their own, as they set what JAX reads when it starts."""

import json
import os
import socket
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


TOGETHER = """
import json, os
if {one_core}:  # before JAX makes its threads
    os.sched_setaffinity(0, {{sorted(os.sched_getaffinity(0))[{process} % os.cpu_count()]}})
import jax
jax.config.update("jax_enable_x64", True)
jax.distributed.initialize("127.0.0.1:{port}", {count}, {process}, heartbeat_timeout_seconds=10)
import {module}  # it makes arrays: JAX must know of the other processes before
print(json.dumps({module}.{call}))
"""


def run_together(
    count: int, module: str, call: str, *, one_core: bool = False, flags: str | None = None
) -> list[Any]:
    """What a call of a function of a module gives in each of some processes that know one another.

    Each process may have one core alone. `flags` are those of XLA.
    """
    ended = end_together(count, module, call, one_core=one_core, flags=flags)
    for code, _, errors in ended:
        assert code == 0, errors
    return [json.loads(output.splitlines()[-1]) for _, output, _ in ended]


def end_together(
    count: int, module: str, call: str, *, one_core: bool = False, flags: str | None = None
) -> list[tuple[int, str, str]]:
    """The same where processes may fail: the exit status of each, and its two streams."""
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    if flags is not None:
        environment["XLA_FLAGS"] = flags
    given = {"count": count, "module": module, "call": call, "one_core": one_core}
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = [
        subprocess.Popen(
            [
                sys.executable,
                "-c",
                TOGETHER.format(port=port, process=i, **given),
            ],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(count)
    ]
    ended = []
    for process in started:
        output, errors = process.communicate(timeout=600)
        ended.append((process.returncode, output, errors))
    return ended
