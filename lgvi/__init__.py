"""Lie-group variational integrators for rigid-body attitude, in JAX and Equinox."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .names import *  # noqa: F403

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import all names when one of them is first used: the command `lgvi` starts without JAX."""
    if name.startswith("_") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    names = vars(import_module(".names", __name__))
    public = {key: value for key, value in names.items() if not key.startswith("_")}
    globals().update(public, __all__=list(public))
    if name not in globals():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals()[name]


def __dir__() -> list[str]:
    return [*__getattr__("__all__"), "__version__"]
