"""Pieces of a page in HTML: words, lists, tables, pictures and sections."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape

SIGNS = {"good": "✓", "doubt": "?", "bad": "✗"}


def text(words: str) -> str:
    """Words, with what is in backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(words))


def paragraph(words: str) -> str:
    """A paragraph."""
    return f"<p>{text(words)}</p>"


def heading(words: str) -> str:
    """The heading of a part of a section."""
    return f"<h3>{text(words)}</h3>"


def items(lines: Iterable[str]) -> str:
    """A list; nothing if there are no lines."""
    inner = "".join(f"<li>{text(line)}</li>" for line in lines)
    return f"<ul>{inner}</ul>" if inner else ""


def definitions(facts: Mapping[str, str]) -> str:
    """Names, and what they have."""
    inner = "".join(f"<div><dt>{text(k)}</dt><dd>{text(v)}</dd></div>" for k, v in facts.items())
    return f"<dl>{inner}</dl>"


def code(words: str) -> str:
    """Lines of a program, or of a shell."""
    return f'<pre tabindex="0"><code>{escape(words)}</code></pre>'


def verdict_of(kind: str, words: str, reasons: Sequence[str]) -> str:
    """A verdict, `"good"`, `"doubt"` or `"bad"`, with its reasons."""
    words = f"{words[:1].upper()}{words[1:]}"
    sign = f'<span aria-hidden="true">{SIGNS[kind]}</span>'
    return f'<div class="verdict {kind}"><p>{sign} {text(words)}</p>{items(reasons)}</div>'


def table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    strong: Collection[int] = (),
    kind: str = "",
) -> str:
    """A table, whose first column names its rows; some rows, by number, are strong."""
    lines = []
    for number, (name, *cells) in enumerate(rows):
        inner = "".join(f"<td>{text(cell)}</td>" for cell in cells)
        emphasis = ' class="strong"' if number in strong else ""
        lines.append(f'<tr{emphasis}><th scope="row">{text(name)}</th>{inner}</tr>')
    heads = "".join(f'<th scope="col">{text(name)}</th>' for name in head)
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{escape(caption)}">'
        f'<table class="{kind}"><caption>{text(caption)}</caption><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def picture(svg: str, caption: str) -> str:
    """A picture with words below it."""
    return f"<figure>{svg}<figcaption>{text(caption)}</figcaption></figure>"


def grid(pictures: Iterable[str]) -> str:
    """Pictures side by side, as many as have room."""
    return f'<div class="grid">{"".join(pictures)}</div>'


class Section:
    """A section with a heading, to which a link goes."""

    def __init__(self, title: str, name: str, *parts: str):
        self.title, self.name, self.parts = title, name, parts

    def __str__(self) -> str:
        inner = "".join(self.parts)
        return f'<section id="{self.name}"><h2>{text(self.title)}</h2>{inner}</section>'
