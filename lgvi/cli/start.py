"""Where the command `lgvi` starts."""

import sys


def main() -> None:
    """Run the command, or say which package it needs."""
    try:
        import click  # noqa: F401
    except ImportError:
        sys.exit('lgvi: the command needs the package `click`: pip install "lgvi[logs]"')
    from .commands import lgvi

    lgvi()
