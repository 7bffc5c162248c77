"""Pictures of Matplotlib as SVG within a page, in the colours of the page, light or dark."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from io import StringIO
from typing import Any, cast

import matplotlib as mpl
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from .style import COLORS, darker

INK = "#010203"  # stands for the colour of the page's text
DOT = 2.4  # diameter of a reading, points
STYLE = {
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor"), INK),
    **dict.fromkeys(("xtick.color", "ytick.color"), INK),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right"), False),
    "font.size": 9.0,
    "axes.linewidth": 0.7,
    "axes.axisbelow": True,
    "text.parse_math": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "lgvi",  # the same page from the same estimate
    "path.simplify_threshold": 0.2,
}


@contextmanager
def style_of_page() -> Iterator[None]:
    """Matplotlib's own style, whatever the user's is, with colours that `as_svg` knows."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(cast(Any, STYLE))
        yield


def as_svg(figure: Figure, name: str, words: str) -> str:
    """A figure that was drawn in `style_of_page` as an SVG element.

    Ink is `currentColor`. Line `i` in a darker colour has the CSS variable `--line-i`.

    Parameters
    ----------
    figure
        The figure.
    name
        A name for the figure, which no other one in the page has.
    words
        What is seen, for those who do not see it.
    """
    file = StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    content = file.getvalue().partition("<svg")[2]
    content = re.sub(r"(?s)<(metadata|style).*?</\1>|<!--.*?-->", "", content)
    head, _, content = content.partition(">")
    box = re.search(r'viewBox="[^"]*"', head)
    assert box is not None
    content = re.sub(r"(?:\s*<use [^>]*/>){3,}", _as_path, content)
    # Identifiers, of which a page must not have one twice.
    content = content.replace("xlink:href", "href")
    used = set(re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', content))
    used = {first or second for first, second in used}
    content = re.sub(
        r' id="([^"]*)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", content
    )
    content = re.sub(r'(url\(|href=")#', rf"\1#{name}-", content)
    for i, color in enumerate(COLORS):
        content = content.replace(to_hex(darker(color)), f"var(--line-{i})")
    content = content.replace(INK, "currentColor")
    content = re.sub(r"font: ([\d.]+px)[^;\"]*", r"font-size: \1", content)
    content = re.sub(r"<[^>]*>", _rounded, content)
    content = re.sub(r"\s*\n\s*", "\n", content)
    label = escape(words)
    return f'<svg {box[0]} role="img" aria-label="{label}">{content.strip()}'


def _rounded(tag: re.Match[str]) -> str:
    """The coordinates of a tag to a hundredth of a point; words between tags are not touched."""
    return re.sub(r"-?\d+\.\d{3,}", lambda number: f"{round(float(number[0]), 2):g}", tag[0])


def _as_path(uses: re.Match[str]) -> str:
    """Many dots of one colour as one path of points with round ends, which is short."""
    dots = re.findall(r'x="([^"]+)" y="([^"]+)"', uses[0])
    points = "".join(f"M{float(x):.1f} {float(y):.1f}h0" for x, y in dots)
    color = re.search(r"fill: ([^;\"]+)", uses[0])
    opacity = re.search(r"fill-opacity: ([^;\"]+)", uses[0])
    assert color is not None
    style = f"stroke: {color[1]}; stroke-opacity: {opacity[1] if opacity else 1}"
    style = f"fill: none; {style}; stroke-width: {DOT}; stroke-linecap: round"
    return f'<path d="{points}" style="{style}"/>'
