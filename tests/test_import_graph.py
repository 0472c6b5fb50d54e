"""The house's rules: who may know whom, by folder; no circles; no crowded folder; light imports."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = {
    "torch",
    "ot",
    "tslearn",
    "transformers",
    "dask",
    "numba",
    "sklearn",
    "pandas",
    "matplotlib",
    "cv2",
    "av",
    "pycolmap",
    "poselib",
}

OTSYNC = """
compute files progress plugins
types
geometry clocks costs io priors simulate metrics
match align refine
epipolar frames calibrate
sync
recordings
report export bench cli
__main__
"""
"""Floors of otsync, ground first: a folder (or file) knows what stands on floors below, and what ``BESIDE`` allows."""

RECON = """
rotations
raster footage motion
scene
losses observe
backdrop fit evaluate simulate
result
features view
pipeline
bench
cli
__main__
"""

BESIDE = {
    # costs are compared on one clock; lenses are geometry; worlds are made, not read
    "otsync": {
        "clocks": {"geometry"},
        "costs": {"clocks", "geometry"},
        "priors": {"geometry"},
        "metrics": {"simulate"},
        "bench": {"report"},
        "cli": {"report", "export", "bench"},
    },
    "recon": {
        "backdrop": {"fit"},
        "simulate": {"fit"},
    },
}
"""Who on the same floor may be known. match, align and refine never know each other."""

MOST_FILES = 18


def modules_in(source: str, module: str, *, package: bool = False) -> set[str]:
    """Dotted names of everything that the source of ``module`` imports, at any depth.

    ``import a.b`` is a.b, whatever it is called; ``from a.b import c`` is a.b.c, whether c is a module or not.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".")
            up = node.level - package
            base = parts[: len(parts) - up] if node.level else []
            base += node.module.split(".") if node.module else []
            found |= {".".join([*base, alias.name]) for alias in node.names}
    return found


def within(name: str, *packages: str) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_of(path): path for package in ("otsync", "recon") for path in files(package)}


def imports(path: Path) -> set[str]:
    """Everything that a file imports of the two packages, lazy imports too, as dotted names."""
    module = module_of(path)
    names = modules_in(path.read_text(), module, package=path.name == "__init__.py")
    return {name for name in names if within(name, "otsync", "recon")}


def imported_modules(path: Path) -> set[str]:
    """The files behind the names: ``otsync.match.match`` is what ``otsync/match/__init__.py`` takes it from."""
    found = set()
    for name in imports(path):
        while name not in MODULES:
            name = name.rpartition(".")[0]
        found.add(name)
    return found - {module_of(path)}


@pytest.mark.parametrize(
    "line, found",
    [
        ("import otsync", {"otsync"}),
        ("import otsync.match as m", {"otsync.match"}),
        ("import os, otsync.align", {"os", "otsync.align"}),
        ("from otsync import match", {"otsync.match"}),
        ("from otsync.io.scene import Scene as S, open_scene", {"otsync.io.scene.Scene", "otsync.io.scene.open_scene"}),
        ("def f():\n    import otsync.sync", {"otsync.sync"}),
        ("from . import other", {"recon.motion.other"}),
        ("from .other import x", {"recon.motion.other.x"}),
        ("from ..fit import fit", {"recon.fit.fit"}),
        ("x = 'import otsync.match'", set()),
    ],
)
def test_every_kind_of_import_is_seen(line, found):
    assert modules_in(line, "recon.motion.nodes") == found


def test_imports_of_a_package_begin_in_its_folder():
    assert modules_in("from .verb import match", "otsync.match", package=True) == {"otsync.match.verb.match"}
    assert modules_in("from ..types import x", "otsync.match", package=True) == {"otsync.types.x"}


def rooms(package: str, floors: str) -> dict[str, int]:
    """The floor of every folder and file that stands directly in a package."""
    return {name: n for n, line in enumerate(floors.split("\n")) for name in line.split()}


@pytest.mark.parametrize("package, floors", [("otsync", OTSYNC), ("recon", RECON)])
def test_every_folder_has_a_floor(package, floors):
    there = {
        path.name.removesuffix(".py")
        for path in (ROOT / package).iterdir()
        if path.name not in ("__init__.py", "__pycache__") and (path.is_dir() or path.suffix == ".py")
    }
    assert there == set(rooms(package, floors))


@pytest.mark.parametrize("package, floors", [("otsync", OTSYNC), ("recon", RECON)])
def test_nobody_knows_what_stands_above(package, floors):
    floor, wrong = rooms(package, floors), []
    for path in files(package):
        here = path.relative_to(ROOT).with_suffix("").parts
        if len(here) == 2 and here[1] == "__init__":
            continue
        allowed = {name for name, n in floor.items() if n < floor[here[1]]} | BESIDE[package].get(here[1], set())
        for name in imports(path):
            parts = name.split(".")
            # the package's own face gives its version and public names to those on top
            if parts[0] == package and len(parts) > 1 and parts[1] in floor and parts[1] not in {*allowed, here[1]}:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_otsync_never_knows_recon():
    assert not [str(path) for path in files("otsync") if any(within(name, "recon") for name in imports(path))]


ALGORITHMS = tuple(f"otsync.{name}" for name in ("match", "align", "refine", "epipolar", "sync", "recordings"))


def test_only_the_top_of_recon_knows_the_algorithms():
    for path in files("recon"):
        if path.relative_to(ROOT).parts[1] in ("pipeline", "bench", "cli"):
            continue
        beyond = {name for name in imports(path) if within(name, *ALGORITHMS)}
        assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


def test_the_rasterizer_knows_only_the_ground():
    for path in files("recon"):
        if within(module_of(path), "recon.raster"):
            beyond = {name for name in imports(path) if within(name, "otsync")}
            beyond = {name for name in beyond if not within(name, "otsync.compute", "otsync.types")}
            assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


def test_there_are_no_circles():
    """Files that import each other, lazily or not, however long the way round. A package's face only hands names on."""
    known = {
        module: {name for name in imported_modules(path) if MODULES[name].name != "__init__.py"}
        for module, path in MODULES.items()
        if path.name != "__init__.py"
    }
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for other in sorted(known[module]):
                visit(other, (*way, module))
            done.add(module)

    for module in sorted(known):
        visit(module, ())


def test_folders_know_each_other_one_way():
    """Between two folders of a package imports run in one direction only."""
    seen: dict[tuple[str, str], str] = {}
    for module, path in MODULES.items():
        here = ".".join(module.split(".")[:2])
        if module in ("otsync", "recon"):
            continue
        for other in imported_modules(path):
            there = ".".join(other.split(".")[:2])
            if there not in ("otsync", "recon", here):
                seen[here, there] = f"{module} -> {other}"
    both = [f"{seen[a, b]}; {seen[b, a]}" for a, b in seen if a < b and (b, a) in seen]
    assert not both, "\n".join(both)


def test_no_folder_is_crowded():
    for folder in {path.parent for package in ("otsync", "recon", "tests") for path in files(package)}:
        count = len(list(folder.glob("*.py")))
        assert count <= MOST_FILES, f"{folder.relative_to(ROOT)}: {count} files"


def test_tests_stand_where_the_code_stands():
    for package in ("otsync", "recon"):
        for path in files(f"tests/{package}"):
            folder = path.parent.relative_to(ROOT / "tests")
            assert (ROOT / folder).is_dir(), f"{path.relative_to(ROOT)}: there is no {folder}"


@pytest.mark.parametrize(
    "module", ["otsync.cli", "otsync.cli.sync", "otsync.cli.recordings", "otsync.recordings", "otsync.calibrate"]
)
def test_the_command_line_is_light_until_something_runs(module):
    code = f"import sys, {module}; print(' '.join(m.split('.')[0] for m in sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert not {
        "torch",
        "ot",
        "tslearn",
        "transformers",
        "matplotlib",
        "cv2",
        "av",
        "pycolmap",
        "poselib",
        "recon",
    } & set(out.split())


def test_import_loads_nothing_heavy():
    code = "import sys, otsync; print(' '.join(m.split('.')[0] for m in sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert "numpy" in out.split()
    assert not HEAVY & set(out.split())


def test_public_names_exist():
    import otsync

    assert otsync.__all__ == sorted(otsync.__all__, key=lambda n: (not n.isupper(), not n[0].isupper(), n))
    for name in otsync.__all__:
        assert getattr(otsync, name) is not None
