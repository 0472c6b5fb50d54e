"""The renderer as a guest: imports, compiled code and its cache, announcements, threads, forks, the benchmark."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from otsync.bench import record
from otsync.compute import simd, threads
from recon.bench import raster as bench_raster
from recon.raster import render as render_module
from recon.raster import set_threads, warmup
from recon.raster.cpu import kernels, lists
from recon.raster.projection import project
from recon.raster.rendering import ALPHA_MIN, Settings
from tests.recon.scenes import random_scene, run

ROOT = Path(__file__).parents[3]
RENDER = """
import logging, sys, torch
logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
from recon.raster import render
from recon.raster.cpu import kernels, project
K = torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]])
g = [torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3)]
g[0].requires_grad_()
out = render(*g, torch.eye(4)[None], K, 8, 8)
out.colors.sum().backward()
every = (kernels.forward, kernels.backward, kernels.reduce, project.forward, project.backward)
print(sum(sum(k.stats.cache_hits.values()) for k in every), sum(sum(k.stats.cache_misses.values()) for k in every))
"""


def python(code: str, **options) -> subprocess.CompletedProcess:
    environment = {
        "PYTHONPATH": str(ROOT),
        "PATH": os.environ["PATH"],
        "OMP_NUM_THREADS": "1",
        **options.pop("env", {}),
    }
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, **options)


def test_importing_the_renderer_is_light_and_knows_nothing_of_otsync():
    code = (
        "import sys, recon.raster; print([m for m in sys.modules if m.split('.')[0] in ('otsync', 'numba', 'gsplat')])"
    )
    assert python(code).stdout.strip() == "[]"


@pytest.mark.slow
def test_compiled_code_is_kept_and_the_first_compilation_announced(tmp_path):
    first = python(RENDER, env={"NUMBA_CACHE_DIR": str(tmp_path)})
    second = python(RENDER, env={"NUMBA_CACHE_DIR": str(tmp_path)})
    assert first.stdout.split() == ["0", "5"] and "compiles its CPU kernels" in first.stderr, first.stderr
    assert second.stdout.split() == ["5", "0"] and "compiles" not in second.stderr, second.stderr


READ_ONLY = """
import os, tempfile
probe = tempfile.TemporaryFile
def refuse(*args, dir=None, **kwargs):
    if dir is not None and any(str(dir).startswith(root) for root in os.environ["READ_ONLY"].split(":")):
        raise PermissionError(13, "read-only", dir)
    return probe(*args, dir=dir, **kwargs)
tempfile.TemporaryFile = refuse  # how numba finds out whether it may write to a folder; root may write anywhere
"""


@pytest.mark.slow
@pytest.mark.parametrize("home", ["writable", "read-only"])
def test_a_read_only_installation_works(tmp_path, home):
    """Compiled code goes to the user's cache folder; without one it is compiled in memory, and said so."""
    site, folder = tmp_path / "site", tmp_path / "home"
    shutil.copytree(ROOT / "recon", site / "recon", ignore=shutil.ignore_patterns("__pycache__"))
    for path in (site, *site.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    folder.mkdir()
    read_only = str(site) if home == "writable" else f"{site}:{folder}"
    env = {
        "PYTHONPATH": str(site),
        "HOME": str(folder),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "READ_ONLY": read_only,
    }
    first = python(READ_ONLY + RENDER, env=env, cwd=str(tmp_path))
    assert first.returncode == 0, first.stderr
    assert not list(site.rglob("*.nbc"))
    if home == "writable":
        assert "no writable folder" not in first.stderr
        assert first.stdout.split() == ["0", "5"] and list(folder.rglob("*.nbc"))
        second = python(READ_ONLY + RENDER, env=env, cwd=str(tmp_path))
        assert second.stdout.split() == ["5", "0"], second.stderr
    else:
        assert first.stderr.count("no writable folder") == 1
    for path in (site, *site.rglob("*")):
        path.chmod(0o755)


@pytest.mark.slow
def test_a_processor_without_avx_gets_the_same_images(tmp_path):
    """Compiled for the least x86-64 there is: eight lanes, no fused multiply-add."""
    code = "from otsync.compute.simd import LANES; assert LANES == 8, LANES"
    env = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path)}
    assert python(code, env=env).returncode == 0
    tests = ["tests/recon/raster/test_raster_oracle.py", "tests/recon/raster/test_raster_hard_cases.py"]
    code = f"import pytest; raise SystemExit(pytest.main(['-q', '-x', '-m', 'not slow', '-k', 'cpu', *{tests}]))"
    result = python(code, env=env, cwd=ROOT)
    assert result.returncode == 0, result.stdout[-3000:]


def test_compiled_code_is_stale_when_any_source_of_the_kernels_changed():
    stamp = kernels.forward._cache._cache_file._source_stamp
    names = {entry[0] for part in stamp[1:] for entry in part}
    assert {"simd.py", "lists.py", "kernels.py", "project.py", "threads.py"} <= names


def test_the_choice_of_a_back_end_is_announced_once(caplog, monkeypatch):
    module = sys.modules[render_module.__module__]
    monkeypatch.setattr(module, "_announced", set())
    scene = random_scene(n=3)
    with caplog.at_level(logging.WARNING, "recon.raster"):
        for _ in range(3):
            assert scene.render("auto").backend == "cpu"
    assert len([r for r in caplog.records if "renders with backend 'cpu'" in r.message]) == 1


def test_without_numba_torch_renders_and_says_what_it_costs(caplog, monkeypatch):
    module = sys.modules[render_module.__module__]
    monkeypatch.setattr(module, "_announced", set())
    monkeypatch.setattr(module, "_has_numba", lambda: False)
    scene = random_scene(n=3)
    with caplog.at_level(logging.WARNING, "recon.raster"):
        assert scene.render("auto").backend == "torch"
        warmup()
    assert "numba is not installed" in caplog.text
    with pytest.raises(ValueError, match="pip install numba"):
        scene.render("cpu")


def test_a_forked_child_renders():
    """The child inherits the pool but none of its threads, and must not wait for them."""
    scene = random_scene(n=3000, width=200, height=100, seed=1)
    outputs, _ = run(scene, "cpu")
    child = os.fork()
    if child == 0:
        status = 1
        try:
            torch.set_num_threads(1)
            status = int(not torch.equal(scene.render("cpu").colors, outputs[0]))
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_an_error_in_a_kernel_reaches_the_caller():
    def kernel(first, last):
        if first == 30:
            raise RuntimeError("broken kernel")

    before = threads.get_threads()
    try:
        set_threads(3)
        with pytest.raises(RuntimeError, match="broken kernel"):
            threads.for_each(kernel, threads.ranges(100, 10))
        with pytest.raises(ValueError, match="at least one thread"):
            set_threads(0)
    finally:
        set_threads(before)


@numba.njit
def _lanes(x, out):
    v = simd.load(x, 0)
    simd.store(out, 0, simd.exp2_nonpositive(v))
    simd.store(out, simd.LANES, simd.select(v >= np.float32(-1), v, np.float32(7)))
    simd.store(out, 2 * simd.LANES, simd.counting_from(np.int32(5)) - v * np.float32(2))
    simd.store(out, 3 * simd.LANES, simd.minimum(simd.maximum(v, np.float32(-3)), np.float32(-0.5)))
    nothing = v > np.float32(1)
    return simd.total(v), simd.any_lane(v < np.float32(-1)), simd.any_lane(nothing)


def test_vectors_do_what_their_names_say():
    g = np.random.default_rng(0)
    for scale in (0.01, 1.0, 8.0, 60.0, 1000.0):
        x = -(scale * g.random(simd.LANES)).astype(np.float32)
        x[0] = 0
        out = np.zeros(4 * simd.LANES, np.float32)
        total, some, none = _lanes(x, out)
        rows = out.reshape(4, -1)
        true = np.exp2(np.maximum(x.astype(np.float64), -126))
        np.testing.assert_allclose(rows[0], true, rtol=2e-7)
        np.testing.assert_array_equal(rows[1], np.where(x >= -1, x, 7))
        np.testing.assert_allclose(rows[2], 5 + np.arange(simd.LANES) - 2 * x, rtol=1e-6)
        np.testing.assert_array_equal(rows[3], np.clip(x, -3, -0.5))
        np.testing.assert_allclose(total, x.sum(dtype=np.float64), rtol=1e-6)
        assert some == (x < -1).any() and not none


@hypothesis_settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.sampled_from([0.01, 0.5, 1.0, 1.0000001, 2.0, 1e3, 3e9]) | st.floats(2**-7, 2**33, width=32), max_size=60
    )
)
def test_depth_order_is_a_stable_sort(values):
    depths = np.array(values, np.float32)
    radii = np.ones((len(depths), 2), np.int32)
    radii[::5] = 0
    drawn = np.flatnonzero(radii[:, 0])
    np.testing.assert_array_equal(lists.depth_order(depths, radii), drawn[np.argsort(depths[drawn], kind="stable")])


@pytest.mark.parametrize("seed", range(4))
def test_every_pixel_a_splat_touches_is_in_a_tile_that_lists_it(seed):
    scene = random_scene(n=400, width=150, height=50, cameras=2, seed=80 + seed, cover=6)
    s = project(
        *(scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats, scene.Ks, 150, 50), Settings()
    )
    arrays = tuple(t.numpy() for t in (s.means2d, s.rows, s.depths, s.opacities, s.radii, s.residuals))
    tiles = lists.build(arrays, 150, 50)
    listed = set()
    for tile in range(len(tiles.tile_starts) - 1):
        ranks = tiles.ranks[tiles.tile_starts[tile] : tiles.tile_starts[tile + 1]]
        assert (np.diff(ranks) > 0).all()
        listed |= {(tile, int(tiles.splat_of_rank[r])) for r in ranks}
    assert sorted(tiles.slots.tolist()) == list(range(len(tiles.ranks)))
    touched = set()
    ys, xs = np.meshgrid(np.arange(50) + 0.5, np.arange(150) + 0.5, indexing="ij")
    for m in tiles.splat_of_rank:
        camera, i = divmod(int(m), 400)
        var_x, slope, var_y = s.rows[camera, i].double().tolist()
        dx, dy = xs - s.means2d[camera, i, 0].item(), ys - s.means2d[camera, i, 1].item()
        alpha = s.opacities[camera, i].item() * np.exp(-0.5 * ((dx - slope * dy) ** 2 / var_x + dy**2 / var_y))
        for y, x in zip(*np.nonzero(alpha >= ALPHA_MIN * 1.0001), strict=True):
            tile = y // lists.TILE_HEIGHT * tiles.tiles_across + x // lists.TILE_WIDTH
            touched.add((camera * tiles.tiles_per_camera + tile, int(m)))
    assert touched <= listed
    assert len(listed) < 1.35 * len(touched)  # the lists are tight: few tiles are tested in vain


@pytest.mark.slow
def test_the_benchmark_writes_its_files_and_its_gate_closes(tmp_path, monkeypatch, capsys):
    baseline = tmp_path / "baseline.json"
    monkeypatch.setattr(record, "baseline_path", lambda name: baseline)
    monkeypatch.setattr(bench_raster, "LEAST_RATIO", {})
    options = {"scenes": [(48, 32, 200)], "channels": [3], "repeats": 3, "with_fit": False}
    assert bench_raster.run(tmp_path / "out", rebase=True, gate=True, **options) == 0
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"raster.csv", "raster.json", "raster.png"}
    report = json.loads((tmp_path / "out" / "raster.json").read_text())
    assert {row["backend"] for row in report["rows"]} >= {"cpu", "torch"}
    assert (report["machine"]["versions"]["torch"] and "gsplat" in report["skipped"]) or torch.cuda.is_available()
    assert all(row["difference_p999"] < 1e-5 for row in report["rows"])
    known = json.loads(baseline.read_text())
    known["figures"] = {key: 1e6 for key in known["figures"]}
    baseline.write_text(json.dumps(known))
    assert bench_raster.run(tmp_path / "out", gate=True, **options) == 1
    assert "behind" in capsys.readouterr().out


def test_the_committed_baseline_covers_the_bars():
    ratios = json.loads(record.baseline_path("raster").read_text())["figures"]
    assert len(ratios) == 8
    for key, ratio in ratios.items():
        assert ratio >= (15 if "3 channels" in key and "32" not in key else 8), key
