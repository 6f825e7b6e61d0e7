"""The architecture, as far as files and imports show it."""

from __future__ import annotations

import ast
import functools
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import ncv_cl
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.opencl.program import kernel_folder

PACKAGE = Path(ncv_cl.__file__).parent
MODULES = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")}
KERNELS = sorted(kernel_folder().glob("*/*.cl"))
# The one rule: data goes from folder to folder in this order, and a folder imports from those before it.
FOLDERS = [
    "host",
    "machines",
    "opencl",
    "scene",
    "points",
    "integrands",
    "visibility",
    "network",
    "settings",
    "sampling",
    "integration",
    "learning",
    "estimation",
    "output",
    "rendering",
    "sensing",
    "commands",
]
MOST_FILES, MOST_LINES = 12, 400
# A floating-point literal without an f.
DOUBLE = re.compile(r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+(?=[eE]))(?:[eE][-+]?\d+)?(?![\w.])")


@functools.cache
def imports(module: str) -> set[str]:
    """Dotted names, inside the package, of the modules that `module` imports."""
    found = set()
    package = ["ncv_cl", *module.split(".")[:-1]]
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) + 1 - node.level] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            # A module of a package, or else something that the package itself defines.
            inner = (f"{base}.{alias.name}" for alias in node.names)
            targets = [one if one.removeprefix("ncv_cl.") in MODULES else base for one in inner]
        else:
            continue
        for target in targets:
            name = target.removeprefix("ncv_cl.")
            name = name if name in MODULES else f"{name}.__init__"
            if target.startswith("ncv_cl.") and name in MODULES:
                found.add(name)
    return found - {module}


def folder(module: str) -> str:
    return module.split(".")[0]


@functools.cache
def strings(path: Path) -> set[str]:
    """The string constants of a module."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)}


def code(kernel: Path) -> str:
    """A kernel file's text without its comments."""
    return re.sub(r"/\*.*?\*/|//[^\n]*", " ", kernel.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_imports_from_those_before_it(name):
    before = set(FOLDERS[: FOLDERS.index(name) + 1])
    late = {
        f"{module} imports {other}"
        for module in MODULES
        if folder(module) == name
        for other in imports(module)
        if folder(other) not in before
    }
    assert late == set()


def test_no_import_goes_in_a_circle():
    order = list(TopologicalSorter({name: imports(name) for name in MODULES}).static_order())
    assert set(order) == set(MODULES)


def test_folders_are_those_of_the_order_and_kernels_have_the_same():
    assert {folder(module) for module in MODULES} == {*FOLDERS, "__init__", "cli"}
    assert {kernel.parent.name for kernel in KERNELS} <= set(FOLDERS)


def test_no_folder_is_crowded_and_no_file_is_long():
    for name in FOLDERS:
        assert len(list((PACKAGE / name).glob("*.py"))) <= MOST_FILES, name
    for path in [*MODULES.values(), *KERNELS]:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES, path


def test_every_kernel_file_is_used_and_not_before_its_folder():
    assert len({kernel.stem for kernel in KERNELS}) == len(KERNELS)
    for kernel in KERNELS:
        # A name may be put together from a prefix and an option.
        prefix = kernel.stem.split("_")[0] + "_"
        users = {folder(m) for m in MODULES if {kernel.stem, prefix} & strings(MODULES[m])}
        assert users & set(FOLDERS[FOLDERS.index(kernel.parent.name) :]), kernel
    for name, integrand in INTEGRANDS.items():
        assert integrand.files[-1] == name


def test_every_folder_says_what_it_is_for():
    for name in FOLDERS:
        assert ast.get_docstring(ast.parse(MODULES[f"{name}.__init__"].read_text(encoding="utf-8")))


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda path: path.name)
def test_kernel_file_says_what_it_does_and_is_self_contained(kernel):
    text = kernel.read_text(encoding="utf-8")
    assert text.startswith("/* ")
    prose = text[: text.index("*/")]
    assert len(prose.split()) > 30 and "Work-group contract" in prose
    assert "#include" not in text
    assert DOUBLE.findall(code(kernel)) == [], "floating-point literals need an f"
