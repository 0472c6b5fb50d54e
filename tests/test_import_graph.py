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
    "match": {"types", "costs", "frontier", "sinkhorn", "vouch", "anchored"},
    "trust": set(),
    "graph": set(),
    "scan": {"types", "costs", "clock", "splines", "kernels", "trust"},
    "align": {"types", "costs", "clock", "kernels", "scan"},
    "fit": {"splines", "kernels"},
    "refine": {"types", "costs", "clock", "splines", "fit", "trust"},
    "rematch": {"types", "costs", "splines", "kernels"},
    "settle": {"types", "graph", "trust"},
    "metrics": {"types", "simulate"},
    "simulate": {"types", "files"},
    "io": {"types", "files"},
    "geometry": {"types"},
    "priors": {"types", "files", "geometry", "jit"},
    "lift": {"types"},
    "tracks": {"types", "geometry", "priors", "kernels_tracks"},
    "position_costs": {"types", "costs", "kernels_tracks"},
    "partners": {"types", "costs", "match", "position_costs"},
    "epipolar": {"types", "clock", "splines", "align", "geometry", "kernels_tracks"},
    "epipolar_fit": {"types", "clock", "splines", "epipolar", "geometry", "trust"},
    "check": {"types", "geometry", "io"},
    "command_line": {"__version__"},
}


def imported(path: Path, package: str) -> set[str]:
    """First names inside ``package`` that a module imports, at any depth, except under TYPE_CHECKING."""
    tree = ast.parse(path.read_text())
    here = path.relative_to(ROOT / package).parts
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            if node.level:
                base = list(here[: len(here) - node.level])
                parts = base + (node.module.split(".") if node.module else [])
                found |= {parts[0]} if parts else {alias.name for alias in node.names}
            elif node.module and node.module.split(".")[0] == package:
                rest = node.module.split(".")[1:]
                found |= {rest[0]} if rest else {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("story", sorted(ALLOWED))
def test_dependencies_point_one_way(story):
    home = ROOT / "otsync" / story
    files = sorted(home.rglob("*.py")) if home.is_dir() else [home.with_suffix(".py")]
    for path in files:
        beyond = imported(path, "otsync") - ALLOWED[story] - {story}
        assert not beyond, f"{path.relative_to(ROOT)} imports {beyond}"


def test_the_rasterizer_knows_only_types():
    for path in sorted((ROOT / "recon" / "raster").rglob("*.py")):
        assert "from otsync" not in path.read_text() or "from otsync.types" in path.read_text(), path


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


def test_recon_never_imports_the_algorithms():
    for path in sorted((ROOT / "recon").rglob("*.py")):
        if path.parent.name == "recon" and path.name in ON_TOP:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                if name.split(".")[0] == "otsync":
                    allowed = (
                        "otsync.types",
                        "otsync.io",
                        "otsync.files",
                        "otsync.simulate",
                        "otsync.bench.record",
                        "otsync.bench",
                    )
                    assert name.startswith(allowed), f"{path.relative_to(ROOT)} imports {name}"


def test_nothing_in_recon_imports_what_stands_on_top():
    names = {f"recon.{name[:-3]}" for name in ON_TOP}
    for path in sorted((ROOT / "recon").rglob("*.py")):
        if path.name in ON_TOP:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            found = {node.module} if isinstance(node, ast.ImportFrom) else set()
            found |= {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            assert not names & found, f"{path.relative_to(ROOT)} imports {names & found}"


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
