"""What the library is measured against: hand-written C and textbook JAX."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

SOURCE = Path(__file__).with_name("tumble.c")


def compiled_c(folder):
    """The function in `tumble.c`, compiled by the system's compiler for this very machine."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler (cc, gcc or clang) on this machine")
    library = folder / "tumble.so"
    flags = ["-O3", "-march=native", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, SOURCE, "-o", library], check=True)
    tumble = ctypes.CDLL(str(library)).tumble
    tumble.restype = None
    doubles = np.ctypeslib.ndpointer(np.float64, flags="C")
    tumble.argtypes = [ctypes.c_long, ctypes.c_int, *[doubles] * 4, ctypes.c_long]
    tumble.argtypes += [ctypes.c_void_p, doubles, doubles]

    def simulate(R0, pi0, J, dt, steps, torques=None, newton=3):
        R, pi = np.empty((steps + 1, 3, 3)), np.empty((steps + 1, 3))
        state = [np.ascontiguousarray(x, float) for x in (R0, pi0, J, np.atleast_1d(dt))]
        torques = None if torques is None else np.ascontiguousarray(torques, float)
        pointer = None if torques is None else torques.ctypes.data  # `run` keeps the array

        def run():
            tumble(steps, newton, *state, int(np.ndim(dt) > 0), pointer, R, pi)
            return R, pi, torques

        return run

    return simulate


def textbook(R0, pi0, J, h, steps):
    """The same map as it is mostly written: exponential chart, automatic Jacobian, linear solve.

    Each of eight Newton iterations keeps the best of four damping factors; gradients go
    through all of it.
    """

    def hat(v):
        return jnp.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    def exp(v):
        angle2 = v @ v
        small = angle2 < 1e-12
        angle = jnp.sqrt(jnp.where(small, 1.0, angle2))
        a = jnp.where(small, 1 - angle2 / 6, jnp.sin(angle) / angle)
        b = jnp.where(small, 0.5 - angle2 / 24, (1 - jnp.cos(angle)) / angle**2)
        return jnp.eye(3) + a * hat(v) + b * hat(v) @ hat(v)

    Jd = jnp.trace(J) / 2 * jnp.eye(3) - J

    def step(state, _):
        R, pi = state

        def residual(g):
            F = exp(g)
            S = F @ Jd - Jd @ F.T
            return jnp.array([S[2, 1], S[0, 2], S[1, 0]]) - h * pi

        def iterate(g, _):
            newton = jnp.linalg.solve(jax.jacfwd(residual)(g), residual(g))
            trials = g[None] - jnp.array([0.0, 0.25, 0.5, 1.0])[:, None] * newton[None]
            norms = jnp.linalg.norm(jax.vmap(residual)(trials), axis=1)
            return trials[jnp.argmin(norms)], None

        g, _ = jax.lax.scan(iterate, h * jnp.linalg.solve(J, pi), length=8)
        F = exp(g)
        after = R @ F, F.T @ pi
        return after, after

    return jax.lax.scan(step, (R0, pi0), length=steps)[1]
