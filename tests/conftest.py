"""Settings of every test: strict promotion, checked annotations, a precision to choose."""

import os

os.environ.setdefault("MPLBACKEND", "Agg")

from jaxtyping import install_import_hook

with install_import_hook("lgvi", "beartype.beartype"):
    import lgvi  # noqa: F401

import jax
import jax.numpy as jnp
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    return jnp.dtype(request.param)


@pytest.fixture(scope="module", autouse=True)
def compiled_programs_are_let_go():
    """A process has room for only so many of them: each takes mapped memory, which has a limit."""
    yield
    jax.clear_caches()


@pytest.fixture
def unchecked(monkeypatch):
    """Annotations are not checked, as for a user: the library's own errors come out."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
