"""Where the command `lgvi` starts."""

import sys


def main() -> None:
    """Run the command; an error of its use is one line."""
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
