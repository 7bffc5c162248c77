"""The folder in which compiled programs are kept from run to run."""

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """The folder of the user for what can be computed again."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "lgvi"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "lgvi"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lgvi"


def keep_programs() -> None:
    """Let JAX keep compiled programs there, however quickly they were compiled."""
    import jax

    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
