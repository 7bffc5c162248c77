"""Where the command `lgvi` starts."""

import atexit
import gc
import sys


def main() -> None:
    """Run the command; an error of its use is one line."""
    # Imports and traces of programs make many objects that stay, and hardly any garbage: to look
    # for it as often as Python does, and once more at the end, takes a fifth of a run.
    gc.set_threshold(50_000)
    atexit.register(gc.freeze)
    try:
        import click
    except ImportError:
        sys.exit('lgvi: error: the command needs the package `click`: pip install "lgvi[logs]"')
    from .commands import WRONG_INPUT, lgvi

    try:
        sys.exit(lgvi(standalone_mode=False))
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
    except click.ClickException as error:
        print(f"lgvi: error: {error.format_message()} (see --help)", file=sys.stderr)
        sys.exit(WRONG_INPUT)
    except BrokenPipeError:  # of `lgvi info LOG | head`
        sys.exit(1)
