"""Settings of every test: strict promotion, checked annotations, a precision to choose.

`README.md` beside this file says how the suite is kept fast.
"""

import ctypes
import gc
import mmap
import os
import platform
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")

from jaxtyping import install_import_hook

with install_import_hook("lgvi", "beartype.beartype"):
    import lgvi  # noqa: F401

import jax
import jax.numpy as jnp
import jaxtyping
import pytest

from lgvi.core.trajectory.chunks import ChunkSizes, chunk_sizes

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Programs are compiled several times as fast with these, and run somewhat slower.
QUICK_TO_COMPILE = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
if platform.machine() in ("x86_64", "AMD64"):
    # Compiled like this, a number that two loops read is computed in each of them. Without fused
    # multiply-add, which AVX does not have, it is the same number in both.
    QUICK_TO_COMPILE += " --xla_cpu_max_isa=AVX"
# Bytes of a process that holds many compiled programs. They take mappings too, of which Linux
# allows a process 65,530: about 5,000 by then.
MUCH_MEMORY = 0.9e9


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the long tests and variants too")
    text = "compile every program as for a user, which takes two to five times as long"
    parser.addoption("--optimised", action="store_true", help=text)


def pytest_configure(config):
    timed = any("benchmarks" in argument for argument in config.args)
    timed &= not config.getoption("--benchmark-disable", False)
    if not config.getoption("--optimised") and not timed:
        # XLA reads them when the first array is made; what the user has set comes last and wins.
        os.environ["XLA_FLAGS"] = f"{QUICK_TO_COMPILE} {os.environ.get('XLA_FLAGS', '')}"


def pytest_collection_modifyitems(config, items):
    if not config.getoption("--slow"):
        slow = [item for item in items if item.get_closest_marker("slow")]
        items[:] = [item for item in items if not item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=slow)


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    return jnp.dtype(request.param)


@pytest.fixture(scope="module", autouse=True)
def files_leave_little_behind():
    """Neither objects to go through again and again, nor too many compiled programs."""
    # JAX keeps millions of objects; who collects garbage, or looks for leaks, skips the frozen.
    gc.collect()
    gc.freeze()
    yield
    pages = Path("/proc/self/statm")  # the second number: those in memory
    if not pages.exists() or int(pages.read_text().split()[1]) * mmap.PAGESIZE > MUCH_MEMORY:
        gc.unfreeze()
        jax.clear_caches()
        if pages.exists():  # the usual C library of Linux keeps half of it until it is asked
            getattr(ctypes.CDLL(None), "malloc_trim", bool)(0)


@pytest.fixture
def unchecked(monkeypatch):
    """Annotations are not checked, as for a user: the library's own errors come out."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def set_chunk_sizes():
    """A function that sets how many steps of a trajectory are computed at once."""
    before = chunk_sizes.get()
    yield lambda **sizes: chunk_sizes.set(ChunkSizes(**sizes))
    chunk_sizes.set(before)
