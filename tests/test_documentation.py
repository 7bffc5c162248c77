"""The documentation tells the truth: its code runs, and it covers every public name."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lgvi
import lgvi.identification
import lgvi.logs
import lgvi.names
import lgvi.plotting

from .public import public_names

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
WITH_CODE = [page for page in PAGES if "```python" in page.read_text(encoding="utf-8")]
SCRIPTS = ROOT / "docs" / "scripts.md"
TIME_LIMIT = 300  # s; a page takes some seconds on a machine of its own


def blocks(text, language):
    """Fenced blocks of one language, each with the number of lines before it."""
    pattern = re.compile(rf"^```{language}\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    return [(text.count("\n", 0, match.start(1)), match[1]) for match in pattern.finditer(text)]


def script(text):
    """The Python blocks on the lines where they stand, so that tracebacks point to the page."""
    lines = [""] * len(text.splitlines())
    for start, block in blocks(text, "python"):
        code = block.splitlines()
        lines[start : start + len(code)] = code
    return "\n".join(lines)


NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def is_same_but_for_rounding(line, other):
    """Whether two lines have the same words, and numbers that differ by a fifth at most."""
    if NUMBER.sub("0", line).split() != NUMBER.sub("0", other).split():
        return False
    pairs = zip(NUMBER.findall(line), NUMBER.findall(other), strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.2, abs=1e-6) for a, b in pairs)


def programs():
    """Each page as one program, by its name; but each section of the page of scripts is one."""
    for page in WITH_CODE:
        name, text = page.relative_to(ROOT).as_posix(), page.read_text(encoding="utf-8")
        if page != SCRIPTS:
            yield name, text
            continue
        starts = [match.start() for match in re.finditer(r"^## ", text, re.MULTILINE)]
        for number, (start, end) in enumerate(zip(starts, [*starts[1:], None], strict=True), 1):
            before = text.count("\n", 0, start)
            yield f"{name}, script {number}", "\n" * before + text[start:end]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        pytest.param(name, text, id=name, marks=() if name == "README.md" else pytest.mark.slow)
        for name, text in programs()
    ],
)
def test_code_runs_as_a_user_would_run_it(name, text, tmp_path):
    # No indented or differently written fence may slip through.
    assert len(blocks(text, "python")) == len(re.findall(r"^\s*[`~]{3,}\s*python", text, re.M))
    file = tmp_path / Path(name.partition(",")[0]).with_suffix(".py").name
    file.write_text(script(text), encoding="utf-8")
    # A process of its own, without the settings of the tests.
    ours = ("JAX_", "EQX_", "JAXTYPING_", "PYTHONWARNINGS")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    # Where to run, and what is compiled already, is not how to compute.
    for name in os.environ:
        if name.startswith(("JAX_PLATFORM", "JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")):
            environment[name] = os.environ[name]
    environment |= {"MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, str(file)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT,
    )
    assert done.returncode == 0, f"{name}:\n{done.stderr}"
    printed = done.stdout.splitlines()
    for start, block in blocks(text, "text"):
        for number, line in enumerate(block.splitlines(), start + 1):
            if line not in ("", "..."):
                same = any(is_same_but_for_rounding(line, other) for other in printed)
                assert same, f"{name}:{number} is not printed: {line}"


@pytest.mark.parametrize(
    "name",
    [
        *public_names(lgvi.names),
        *(f"identification.{name}" for name in public_names(lgvi.identification)),
        *(f"logs.{name}" for name in public_names(lgvi.logs)),
        *(f"plotting.{name}" for name in public_names(lgvi.plotting)),
    ],
)
def test_public_name_is_in_the_reference(name):
    reference = "\n".join(page.read_text(encoding="utf-8") for page in ROOT.glob("docs/api/*.md"))
    assert re.search(rf"^::: lgvi\.(core\.)?{name}$", reference, re.MULTILINE)


def test_scripts_are_short():
    scripts = blocks(SCRIPTS.read_text(encoding="utf-8"), "python")
    assert len(scripts) == 3
    for _, code in scripts:
        assert sum(bool(line.strip()) for line in code.splitlines()) <= 25


def test_readme_sets_up_with_two_commands():
    commands = [block.splitlines() for _, block in blocks((ROOT / "README.md").read_text(), "sh")]
    assert len(commands) == 2
    assert all(len(lines) == 1 and lines[0].startswith("pip install") for lines in commands)
    (example,), (tests,) = commands
    assert "examples/fit_inertia.py" in example
    assert "pytest" in tests
