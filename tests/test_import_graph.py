"""Dependencies point one way, and importing the library is light."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "ot", "tslearn", "transformers", "dask", "numba", "sklearn", "pandas", "matplotlib", "cv2", "av"}

#: what each story may import from the package; folders count as their first name
ALLOWED = {
    "files": set(),
    "types": {"files"},
    "jit": set(),
    "kernels": {"jit"},
    "costs": {"types", "kernels"},
    "splines": set(),
    "clock": {"types", "splines"},
    "frontier": set(),
    "sinkhorn": set(),
    "vouch": {"types", "costs"},
    "anchored": {"types", "costs", "kernels", "jit", "vouch"},
    "match": {"types", "costs", "shutter", "frontier", "sinkhorn", "vouch", "anchored"},
    "trust": set(),
    "graph": set(),
    "scan": {"types", "costs", "clock", "splines", "kernels", "trust"},
    "align": {"types", "costs", "shutter", "clock", "kernels", "scan"},
    "fit": {"splines", "kernels"},
    "refine": {"types", "costs", "shutter", "clock", "splines", "fit", "trust"},
    "rematch": {"types", "costs", "splines", "kernels"},
    "settle": {"types", "graph", "trust"},
    "metrics": {"types", "simulate"},
    "progress": set(),
    "simulate": {"types", "files", "progress"},
    "io": {"types", "files"},
    "geometry": {"types"},
    "shutter": {"types", "geometry"},
    "priors": {"types", "files", "geometry", "jit"},
    "lift": {"types", "shutter"},
    "tracks": {"types", "geometry", "priors", "kernels_tracks"},
    "position_costs": {"types", "costs", "kernels_tracks"},
    "partners": {"types", "costs", "match", "position_costs"},
    "epipolar": {"types", "clock", "splines", "align", "geometry", "kernels_tracks"},
    "epipolar_fit": {"types", "clock", "splines", "epipolar", "geometry", "trust"},
    "check": {"types", "geometry", "io", "shutter"},
    "command_line": {"__version__"},
}


def modules_in(source: str, module: str) -> set[str]:
    """Dotted names of everything that the source of ``module`` imports, at any depth.

    ``import a.b`` is a.b, whatever it is called; ``from a.b import c`` is a.b.c, whether c is a module or not.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = module.split(".")[: -node.level] if node.level else []
            base += node.module.split(".") if node.module else []
            found |= {".".join([*base, alias.name]) for alias in node.names}
    return found


def imports(path: Path, package: str) -> set[str]:
    """What a file imports of ``package``."""
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return {name for name in modules_in(path.read_text(), module) if within(name, package)}


def within(name: str, *packages: str) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


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


@pytest.mark.parametrize("story", sorted(ALLOWED))
def test_dependencies_point_one_way(story):
    home = ROOT / "otsync" / story
    files = sorted(home.rglob("*.py")) if home.is_dir() else [home.with_suffix(".py")]
    for path in files:
        found = {name.split(".")[1] if "." in name else name for name in imports(path, "otsync")}
        beyond = found - ALLOWED[story] - {story}
        assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


def test_the_rasterizer_knows_only_types():
    for path in sorted((ROOT / "recon" / "raster").rglob("*.py")):
        beyond = {name for name in imports(path, "otsync") if not within(name, "otsync.types")}
        assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


#: what stands on top of both packages: from a recording to a result, its page, and the command line
ON_TOP = {
    "initial.py",
    "prepare.py",
    "pipeline.py",
    "report.py",
    "cli.py",
    "bench.py",
    "bench_lifting.py",
    "commands_bench.py",
}


#: what the rest of recon may import: nouns, readers and writers, when rows were read, worlds with answers, and how figures are written down
LEAVES = (
    "otsync.types", "otsync.io", "otsync.files", "otsync.progress", "otsync.shutter", "otsync.simulate", "otsync.bench",
)  # fmt: skip


def test_recon_never_imports_the_algorithms():
    for path in sorted((ROOT / "recon").rglob("*.py")):
        if path.parent.name == "recon" and path.name in ON_TOP:
            continue
        beyond = {name for name in imports(path, "otsync") if not within(name, *LEAVES)}
        assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


def test_nothing_in_recon_imports_what_stands_on_top():
    names = [f"recon.{name[:-3]}" for name in sorted(ON_TOP)]
    for path in sorted((ROOT / "recon").rglob("*.py")):
        if path.parent.name == "recon" and path.name in ON_TOP:
            continue
        beyond = {name for name in imports(path, "recon") if within(name, *names)}
        assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


def test_the_command_line_is_light_until_something_runs():
    code = "import sys, otsync.cli; print(' '.join(m.split('.')[0] for m in sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert not {"torch", "ot", "tslearn", "transformers", "matplotlib", "cv2", "av", "recon"} & set(out.split())


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
