"""The package as a whole: public names, layers, and no side effects of importing it."""

import ast
import subprocess
import sys
from collections import defaultdict
from graphlib import TopologicalSorter
from pathlib import Path

import equinox as eqx
import pytest

import lgvi
import lgvi.identification
import lgvi.logs
import lgvi.names
import lgvi.plotting

from .public import public_names

ROOT = Path(lgvi.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
PUBLIC = lgvi.names, lgvi.identification, lgvi.logs, lgvi.plotting


def imported(path, on_import=False):
    """Absolute names of everything a file imports, or imports when it is imported itself."""
    package = ["lgvi", *path.relative_to(ROOT).parent.parts]
    names = []
    tree = ast.parse(path.read_text())
    for node in tree.body if on_import else ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *filter(None, [node.module])])
            names += [f"{module}.{alias.name}" for alias in node.names]
    return names


def under(name, package):
    return f"{name}.".startswith(f"{package}.")


def layer(name):
    return [path for path in FILES if path.relative_to(ROOT).parts[0] == name]


def run(script):
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_each_public_name_is_listed_once():
    """As `from .file import name as name` in one list; other packages have a docstring alone."""
    lists = {Path(module.__file__ or "") for module in (*PUBLIC, lgvi.so3)}
    for path in sorted({*lists, *(file for file in FILES if file.name == "__init__.py")}):
        statements = ast.parse(path.read_text()).body[1:]
        if path == ROOT / "__init__.py":
            continue
        if path in lists:
            imports = [node for node in statements if isinstance(node, ast.ImportFrom)]
            names = [alias.name for node in imports for alias in node.names]
            assert names
            assert len(set(names)) == len(names)
            assert all(alias.asname == alias.name for node in imports for alias in node.names)
        else:
            assert not statements or path.parent.name == "sensors"


def test_everything_public_is_documented():
    public = [getattr(module, name) for module in PUBLIC for name in public_names(module)]
    public += [value for name, value in vars(lgvi.so3).items() if public_function(name, value)]
    for cls in [value for value in public if isinstance(value, type)]:
        own = [value for value in (cls, *cls.__mro__) if value.__module__.startswith("lgvi")]
        for owner in own:
            public += [v for n, v in vars(owner).items() if public_function(n, v)]
    assert len(public) > 30
    for value in public:
        assert value.__doc__, value


def public_function(name, value):
    module = getattr(value, "__module__", None) or ""
    return not name.startswith("_") and callable(value) and module.startswith("lgvi")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_are_public_api(path):
    # The documented way to tell a traced value from a concrete one.
    names = [name for name in imported(path) if name != "jax.core.Tracer"]
    forbidden = ("jax._src", "jax.core", "jaxlib", "equinox.internal", "equinox._", "examples")
    assert not [name for name in names if name.startswith(forbidden)]
    plotting = path in layer("plotting")
    drawing = [n for n in names if under(n, "matplotlib") or under(n, "mpl_toolkits")]
    assert plotting or not drawing
    if path not in [
        p for name in ("identification", "logs", "cli", "plotting") for p in layer(name)
    ]:
        # Sensors read recordings too, and import SciPy only then.
        names = imported(path, on_import=path.parent.name == "sensors")
        assert not [n for n in names if under(n, "scipy") or under(n, "tqdm")]


def test_imports_run_one_way():
    core = [name for path in layer("core") for name in imported(path)]
    modules = [name for path in layer("modules") for name in imported(path)]
    assert core
    assert not [n for n in core if under(n, "equinox") or under(n, "optax")]
    inner = [n for n in core if under(n, "lgvi")]
    assert inner
    assert all(under(n, "lgvi.core") for n in inner)
    assert any(under(n, "lgvi.core") for n in modules)
    assert all(
        under(n, "lgvi.core") or under(n, "lgvi.modules") for n in modules if under(n, "lgvi")
    )
    outside = [path for path in FILES if path not in (*layer("plotting"), *layer("cli"))]
    everything = [n for path in outside for n in imported(path)]
    assert not [n for n in everything if under(n, "lgvi.plotting") or under(n, "lgvi.cli")]
    below = [*core, *modules, *(n for path in layer("identification") for n in imported(path))]
    assert not [n for n in below if under(n, "lgvi.logs")]


def test_the_page_on_the_code_names_every_file():
    page = (ROOT.parent / "docs" / "organisation.md").read_text(encoding="utf-8")
    files = {path.name for path in FILES} - {"__init__.py"}
    folders = {f"{path.parent.name}/" for path in FILES}
    assert not [name for name in files | folders if name not in page]


FOLDERS = sorted({path.parent for path in FILES})


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_what_is_in_a_folder_has_no_circle(folder):
    """Its files and folders, each folder as a whole: one that is imported never imports back."""
    package = ".".join(["lgvi", *folder.relative_to(ROOT).parts])
    found = defaultdict(set)
    for path in folder.rglob("*.py"):
        inside = path.relative_to(folder).with_suffix("").parts[0]
        for name in imported(path):
            if inside != "__init__" and under(name, package) and name != package:
                other = name.removeprefix(f"{package}.").split(".")[0]
                found[inside] |= {other} - {inside}
    assert list(TopologicalSorter(found).static_order()) or not found


def test_classes_are_abstract_or_final():
    """A module that is inherited from has no instances: it is named so."""
    assert lgvi.RigidBody in subclasses(lgvi.AbstractRigidBody)
    for cls in subclasses(eqx.Module):
        if cls.__module__.startswith("lgvi") and cls.__subclasses__():
            assert cls.__name__.startswith("Abstract")
    with pytest.raises(TypeError, match="abstract"):
        lgvi.AbstractRigidBody()


def subclasses(cls):
    return [found for sub in cls.__subclasses__() for found in (sub, *subclasses(sub))]


def test_the_version_is_a_version():
    major, minor, patch = lgvi.__version__.split(".")
    assert all(part.isdecimal() for part in (major, minor, patch))


IMPORT_CHANGES_NOTHING = """
import jax, equinox, os
before = dict(jax.config.values), dict(os.environ)
import lgvi
assert (dict(jax.config.values), dict(os.environ)) == before
"""

SINGLE_PRECISION = """
import jax, jax.numpy as jnp, numpy as np, equinox as eqx, lgvi
body = lgvi.PhysicalRigidBody.from_principal_moments(np.array([1.0, 2.0, 2.5]))
integrator = lgvi.MoserVeselovIntegrator(0.1)
run = eqx.filter_jit(lambda pi: integrator.simulate(body, jnp.eye(3), pi, steps=20))
Rs, pis, info = run(jnp.array([0.5, -1.0, 1.5]))
assert Rs.dtype == pis.dtype == info.residual_norm.dtype == jnp.float32
assert bool(info.converged.all())
assert float(lgvi.ortho_error(Rs[-1])) < 1e-5
try:
    run(jnp.array([0.0, 0.0, 50.0]))
except RuntimeError as error:
    assert "a step did not converge" in str(error)
else:
    raise AssertionError("nothing was raised")
"""


def test_importing_changes_no_configuration_and_single_precision_works():
    run(IMPORT_CHANGES_NOTHING + SINGLE_PRECISION)
