"""A fit of ten million attitudes that stay in files, in a process of its own.

It takes eight minutes and half a gigabyte on disk:
python -m pytest -n 0 -q -o python_files="proof_files.py" tests/benchmarks
"""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow
from pyarrow import parquet
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import InitialStates, Model, simulate_recordings

from .tosses import directions

FILES, SAMPLES, AT_ONCE = 1000, 10_000, 50

FIT = """
import resource, sys
from time import perf_counter
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import lgvi
from lgvi.identification import Model, Recordings, identify

start = perf_counter()
recorded = Recordings.open(sys.argv[1], attitude=["w", "x", "y", "z"])
opened = perf_counter()
body = lgvi.PhysicalRigidBody.from_principal_moments([1.0, 1.0, 1.0])
estimate = identify(Model(body, lgvi.AttitudeSensor(1e-3)), recorded)
done, memory = perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
moments = lambda m: jnp.linalg.eigvalsh(m.body.inertia) / jnp.trace(m.body.inertia)
errors = (moments(estimate.model) - jnp.array([0.2, 0.35, 0.45])) / estimate.standard_error(moments)
print(opened - start, done - opened, memory, estimate.converged, jnp.max(abs(errors)))
"""


def write(folder):
    """Motions whose rates are between 1 and 2 rad/s, in any direction, at 50 Hz."""
    body = lgvi.PhysicalRigidBody.from_principal_moments([0.2, 0.35, 0.45])
    model, t = Model(body, lgvi.AttitudeSensor(1e-3)), np.arange(SAMPLES) * 0.02
    random = np.random.default_rng(0)
    for first in range(0, FILES, AT_ONCE):
        omega = directions(random, AT_ONCE) * random.uniform(1, 2, (AT_ONCE, 1))
        R0 = jnp.tile(jnp.eye(3), (AT_ONCE, 1, 1))
        states, key = InitialStates(R0, jnp.asarray(omega)), jax.random.key(first)
        made = simulate_recordings(model, t, states, key=key)
        for i, (_, R) in enumerate(made.channels["attitude"]):
            q = Rotation.from_matrix(R).as_quat(scalar_first=True)
            columns = {"t": t, **dict(zip("wxyz", q.T, strict=True))}
            table = pyarrow.table(columns)
            parquet.write_table(table, folder / f"{first + i:04}.parquet", use_dictionary=False)


def test_a_fit_of_more_than_should_be_in_memory(line, tmp_path):
    write(tmp_path)
    run = subprocess.run(
        [sys.executable, "-c", FIT, str(tmp_path)], capture_output=True, text=True, check=True
    )
    opening, seconds, memory, converged, error = run.stdout.split()
    line(
        f"{f'{FILES} files of {SAMPLES} attitudes':42} opened in {float(opening):.0f} s, fitted in "
        f"{float(seconds):.0f} s; peak memory {float(memory):.2f} GiB; largest error "
        f"{float(error):.1f} standard errors"
    )
    assert converged == "True"
    assert float(error) < 4
