"""The architecture, as far as files and imports show it."""

from __future__ import annotations

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import ncv_cl
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.program import kernel_folder

PACKAGE = Path(ncv_cl.__file__).parent
MODULES = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")}
KERNELS = sorted(kernel_folder().glob("*.cl"))
# Data flows downwards: a module imports only from lines above its own.
ORDER = (
    "caches clock console files interrupt version",
    "runtimes",
    "arrangement certificate clip device image scene_data scene_geometry scene_table",
    "meshes",
    "program scene_place",
    "scene",
    "sampler trace",
    "points",
    "integrands",
    "lines shadow shaft",
    "encode integration_stage warp",
    "samples",
    "guide",
    "paths",
    "network",
    "padded probe",
    "choose",
    "train integrator estimate",
    "allocate alpha auto calibrate density integrate presets resolve",
    "budget held_out settings subdivide triangulate",
    "checkpoint learn passes prepare report",
    "estimation pilot variate",
    "custom first_pass keep stopping",
    "render",
    "split",
    "cli __init__",
)
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names.split()}
# A stage knows its inputs and outputs, not its neighbours: who may import it.
USERS = {
    "train": {"alpha", "density", "learn", "presets"},
    "density": {"checkpoint", "estimation", "learn", "render", "triangulate", "variate"},
    "learn": {"custom", "first_pass", "render", "variate"},
    "alpha": {"learn", "variate"},
    "auto": {"checkpoint", "first_pass", "render"},
    "budget": {"learn"},
    "held_out": {"learn"},
    "passes": {"custom", "estimation", "pilot", "render"},
    "estimation": {"custom", "first_pass", "keep", "render", "stopping"},
    "integrator": {"cli", "integrate", "subdivide", "variate"},
    "integrate": {"cli", "subdivide", "__init__"},
    "estimate": {
        "auto",
        "calibrate",
        "checkpoint",
        "custom",
        "estimation",
        "first_pass",
        "held_out",
        "keep",
        "learn",
        "passes",
        "pilot",
        "render",
        "report",
        "resolve",
    },
    "resolve": {"custom", "render"},
    "render": {"cli", "split", "__init__"},
    "split": {"cli", "__init__"},
    "cli": set(),
}
# A floating-point literal without an f.
DOUBLE = re.compile(r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+(?=[eE]))(?:[eE][-+]?\d+)?(?![\w.])")
# Drivers whose kernel file bears another name than theirs.
OTHER_KERNEL = {"integration_stage": "integrate_robust", "network": "mlp", "probe": "mlp"}


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
            targets = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        else:
            continue
        for target in targets:
            name = target.removeprefix("ncv_cl.")
            name = name if name in MODULES else f"{name}.__init__"
            if target.startswith("ncv_cl.") and name in MODULES:
                found.add(name)
    return found - {module}


def strings(path: Path) -> set[str]:
    """The string constants of a module."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)}


def code(kernel: Path) -> str:
    """A kernel file's text without its comments."""
    return re.sub(r"/\*.*?\*/|//[^\n]*", " ", kernel.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_no_import_goes_in_a_circle():
    order = list(TopologicalSorter({name: imports(name) for name in MODULES}).static_order())
    assert set(order) == set(MODULES)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_go_one_way(module):
    own = module.split(".")[0]
    assert own in RANK, f"{module} has no place in the order of the architecture"
    others = {name.split(".")[0] for name in imports(module)} - {own}
    assert {name for name in others if RANK[name] >= RANK[own]} == set()


@pytest.mark.parametrize("stage", sorted(USERS))
def test_render_alone_orders_the_stages(stage):
    assert {name for name in MODULES if stage in imports(name)} <= USERS[stage]


def test_the_order_names_only_modules_that_exist():
    assert set(RANK) == {name.split(".")[0] for name in MODULES}


def test_every_driver_has_a_kernel_file_of_its_name():
    drivers = [name for name in MODULES if re.search(r"import.*\bbuild\b", MODULES[name].read_text())]
    assert len(drivers) > 5
    stems = {kernel.stem for kernel in KERNELS}
    for name in drivers:
        expected = OTHER_KERNEL.get(name, name)
        assert expected in stems and expected in strings(MODULES[name]), name
    for name, integrand in INTEGRANDS.items():
        assert name in stems and integrand.files[-1] == name


def test_every_kernel_file_is_used():
    used = set().union(*(strings(path) for path in MODULES.values()))
    # A name may be put together from a prefix and an option.
    prefixes = tuple(text for text in used if re.fullmatch("[a-z]+_", text))
    assert {k.stem for k in KERNELS if k.stem not in used and not k.stem.startswith(prefixes)} == set()


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda path: path.name)
def test_kernel_file_says_what_it_does_and_is_self_contained(kernel):
    text = kernel.read_text(encoding="utf-8")
    assert text.startswith("/* ")
    prose = text[: text.index("*/")]
    assert len(prose.split()) > 30 and "Work-group contract" in prose
    assert "#include" not in text
    assert DOUBLE.findall(code(kernel)) == [], "floating-point literals need an f"
