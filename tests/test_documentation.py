"""The documentation tells the truth: its code runs, and it covers every public name."""

import ast
import builtins
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lgvi
import lgvi.identification
import lgvi.plotting

from .public import public_names

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
WITH_CODE = [page for page in PAGES if "```python" in page.read_text(encoding="utf-8")]
# All of them take long: one, of the calls that users write most, is run before each commit.
SCRIPTS = ROOT / "docs" / "scripts.md"
BEFORE_A_COMMIT = [SCRIPTS]
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


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=() if p in BEFORE_A_COMMIT else pytest.mark.slow) for p in WITH_CODE],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_code_runs_as_a_user_would_run_it(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    # No indented or differently written fence may slip through.
    assert len(blocks(text, "python")) == len(re.findall(r"^\s*[`~]{3,}\s*python", text, re.M))
    file = tmp_path / (page.stem + ".py")
    file.write_text(script(text), encoding="utf-8")
    # A process of its own, without the settings of the tests.
    ours = ("JAX_", "EQX_", "JAXTYPING_", "PYTHONWARNINGS")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME"):  # where to run is not how to compute
        if name in os.environ:
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
    assert done.returncode == 0, f"{page.relative_to(ROOT)}:\n{done.stderr}"
    printed = done.stdout.splitlines()
    for start, block in blocks(text, "text"):
        for number, line in enumerate(block.splitlines(), start + 1):
            if line not in ("", "..."):
                same = any(is_same_but_for_rounding(line, other) for other in printed)
                assert same, f"{page.relative_to(ROOT)}:{number} is not printed: {line}"


@pytest.mark.parametrize(
    "name",
    [
        *public_names(lgvi),
        *(f"identification.{name}" for name in public_names(lgvi.identification)),
        *(f"plotting.{name}" for name in public_names(lgvi.plotting)),
    ],
)
def test_public_name_is_in_the_reference(name):
    reference = "\n".join(page.read_text(encoding="utf-8") for page in ROOT.glob("docs/api/*.md"))
    assert re.search(rf"^::: lgvi\.(core\.)?{name}$", reference, re.MULTILINE)


def test_scripts_are_short_and_complete():
    scripts = [block for _, block in blocks(SCRIPTS.read_text(encoding="utf-8"), "python")]
    assert len(scripts) == 3
    for code in scripts:
        assert sum(bool(line.strip()) for line in code.splitlines()) <= 25
        known, used = set(dir(builtins)), set()
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Name):
                (used if isinstance(node.ctx, ast.Load) else known).add(node.id)
            elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                known.add(node.name)
            elif isinstance(node, ast.arg):
                known.add(node.arg)
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                known |= {alias.asname or alias.name for alias in node.names}
        assert used <= known


def test_readme_sets_up_with_two_commands():
    commands = [block.splitlines() for _, block in blocks((ROOT / "README.md").read_text(), "sh")]
    assert len(commands) == 2
    assert all(len(lines) == 1 and lines[0].startswith("pip install") for lines in commands)
    (example,), (tests,) = commands
    assert "examples/fit_inertia.py" in example
    assert "pytest" in tests
