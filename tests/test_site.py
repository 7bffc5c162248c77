"""The built pages: readable without a network, with equations, signatures and a search."""

import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # the site is built
ROOT = Path(__file__).parents[1]
CHROMIUM = shutil.which("chromium") or ""
OF_CODE = {"code", "pre", "script", "style"}
VOID = {"br", "hr", "img", "input", "link", "meta", "source", "wbr"}


class Page(HTMLParser):
    """The text that a page shows outside of code, and what it loads."""

    def __init__(self, html):
        super().__init__()
        self.inside, self.text, self.loaded = [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.inside.append(tag)
        given = dict(attrs)
        if tag != "a" and given.get("rel") not in ("canonical", "next", "prev"):
            self.loaded += [given[name] for name in ("src", "href", "srcset") if given.get(name)]

    def handle_endtag(self, tag):
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data):
        if not OF_CODE & set(self.inside):
            self.text.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert (built.returncode, built.stderr) == (0, "")
    return folder


def pages(site):
    return {str(file.relative_to(site)): file.read_text("utf-8") for file in site.rglob("*.html")}


def test_pages_load_nothing_from_another_host(site):
    for name, html in pages(site).items():
        foreign = [url for url in Page(html).loaded if re.match(r"(https?:)?//", url)]
        assert not foreign, name
        assert 'class="mermaid"' not in html  # for which the theme would load a script
    for file in site.rglob("*.css"):
        loaded = re.findall(
            r"(?:@import\s+(?!url)|url\()\s*[\"']?([^\"')]*)", file.read_text("utf-8")
        )
        assert not [url for url in loaded if re.match(r"(https?:)?//", url)], file.name
    assert (site / "stylesheets" / "STIXTwoMath-Regular.ttf").stat().st_size > 1e6


def require_set(name, html):
    """No equation is left as it was written."""
    text = " ".join(Page(html).text)
    assert not re.search(r"\\[(\[a-z]|\$", text), name


def test_equations_are_set(site):
    for name, html in pages(site).items():
        require_set(name, html)
    theory = (site / "theory" / "index.html").read_text("utf-8")
    assert theory.count("<math") > 100
    assert 'notation="box"' in theory


@pytest.mark.skipif(not CHROMIUM, reason="needs Chromium")
def test_a_browser_shows_equations(site, tmp_path):
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    for name in pages(site):
        shown = subprocess.run(
            [
                CHROMIUM,
                *options,
                f"--user-data-dir={tmp_path}",
                "--dump-dom",
                f"file://{site}/{name}",
            ],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert "<h1" in shown.stdout, name
        require_set(name, shown.stdout)


def test_gallery_pages_show_their_scripts(site):
    shown = [file.read_text("utf-8") for file in (site / "gallery").glob("*/index.html")]
    assert len(shown) == len({*(ROOT / "docs" / "gallery").glob("*.md")}) - 1  # the index
    assert all("argparse" in re.sub(r"<[^>]*>", "", html) for html in shown)


def test_signatures_have_one_argument_a_line_and_links(site):
    html = (site / "api" / "identification" / "index.html").read_text("utf-8")
    (signature,) = re.findall(r"<pre>(?:(?!</pre>).)*?>identify</span>.*?</pre>", html, re.DOTALL)
    lines = re.sub(r"<[^>]*>", "", signature).splitlines()
    assert "    iterations: int = 100," in lines
    assert "#lgvi.identification.Recordings" in signature


@pytest.mark.parametrize("words", ["inertia", "quaternion order", "NaN"])
def test_search_finds(site, words):
    index = json.loads((site / "search" / "search_index.json").read_text("utf-8"))
    assert any(words in section["text"] for section in index["docs"])
