"""What the pages of the gallery show of the output of their examples."""

from pathlib import Path

from ..test_documentation import blocks, is_same_but_for_rounding

GALLERY = Path(__file__).parents[2] / "docs" / "gallery"
PRINTED = {page.stem: blocks(page.read_text("utf-8"), "text") for page in GALLERY.glob("*.md")}


def assert_page_shows(name: str, text: str) -> None:
    """All that the page of an example shows is in what the example prints."""
    printed = text.splitlines()
    for _, block in PRINTED[name]:
        for line in block.splitlines():
            same = any(is_same_but_for_rounding(line, other) for other in printed)
            assert line == "..." or same, line
