"""A hook of mkdocs.yml: equations become MathML when the pages are built.

A browser shows MathML by itself, so that no page needs a script or a network for its equations. The
font is that of the package `ziamath`, as few computers have a font of mathematics. The title of the
pages gets the version of the library.
"""

import html
import re
from importlib.resources import files
from pathlib import Path

from latex2mathml.converter import convert

EQUATION = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL
)
FONT = "STIXTwoMath-Regular.ttf"
# What a browser would set unlike TeX: accents that are no limits, words that are functions, bars
# and strokes without space.
AS_IN_TEX = (
    (r"<mo[^>]*>&#x0005E;</mo></mover>", "<mo>&#x002C6;</mo></mover>"),
    (r"<mo[^>]*>&#x0007E;</mo></mover>", "<mo>&#x002DC;</mo></mover>"),
    (r"<mo[^>]*>&#x000AF;</mo></mover>", "<mo>&#x000AF;</mo></mover>"),
    (r"<mover>(?=(?:(?!<mover).)*?<mo>[^<]*</mo></mover>)", '<mover accent="true">'),
    (
        r'<mo(?: movablelimits="true")?>([a-z]{2,})</mo>(?=<mo[ >])',
        r'<mo lspace=".17em" rspace="0">\1</mo>',
    ),
    (
        r'<mo(?: movablelimits="true")?>([a-z]{2,})</mo>',
        r'<mo lspace=".17em" rspace=".17em">\1</mo>',
    ),
    (
        r'<mo(?: stretchy="false")?>(&#x0007C;|&#x0002F;)',
        r'<mo stretchy="false" lspace="0" rspace="0">\1',
    ),
)


def on_config(config):
    """The title of the pages, with the version of the package."""
    package = Path(config["config_file_path"]).with_name("lgvi") / "__init__.py"
    version = re.search(r'^__version__ = "(.+)"', package.read_text("utf-8"), re.MULTILINE)
    assert version
    config["site_name"] += f" {version[1]}"
    return config


def on_page_content(content: str, **kwargs) -> str:
    """The HTML of a page, with its equations as MathML."""

    def as_mathml(found: re.Match[str]) -> str:
        tag, inline, block = found.groups()
        latex = html.unescape(block if inline is None else inline).strip()
        mathml = convert(latex, display="inline" if block is None else "block")
        for pattern, replacement in AS_IN_TEX:
            mathml = re.sub(pattern, replacement, mathml)
        return f'<{tag} class="equation">{mathml}</{tag}>'

    return EQUATION.sub(as_mathml, content)


def on_post_build(config, **kwargs) -> None:
    """Copy the font to where the style sheet looks for it."""
    font = files("ziamath").joinpath("fonts", FONT).read_bytes()
    (Path(config["site_dir"]) / "stylesheets" / FONT).write_bytes(font)
