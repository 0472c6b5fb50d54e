"""The scene page: what is in the file, and what a real browser shows of it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from recon.motion import BSpline, HermiteSpline, Sampled
from recon.observe import Vignetting
from recon.result import Page
from recon.result.export import export_result
from recon.result.images import rendered
from recon.result.packing import Packing
from recon.result.page import ENGINE, PAGE, _shots, write_page
from recon.result.strips import read_strips, strips_of, write_strips
from tests.browser import Opened, chromium, psnr
from tests.recon.result.filmed import FAR, MOTIONS, SIZE, footage_like, reconstruction, scene_of

WEB = Path(__file__).parents[3] / "recon/result/web"
HOSTILE = ("</script><script>window.hit=1</script>", "\"'><img src=x onerror=window.hit=2>", "Ω 🎾 <b>&amp;\u2028")


# what is in the file


def about_of(path: Path) -> dict[str, Any]:
    return json.loads(re.search(r'id="about">(.*?)</script>', path.read_text())[1])


def test_packed_arrays_are_the_same_to_half_a_step():
    rng = np.random.default_rng(0)
    values, whole = rng.normal(size=(50, 3)) * [1, 10, 0], rng.integers(0, 70_000, 40)
    packing = Packing()
    packing.measured("fine", values, 16)
    packing.measured("coarse", values, 8)
    packing.measured("too wide", values, 8, finest=1e-3)
    packing.whole("whole", whole)
    raw, found = zlib.decompress(base64.b64decode(packing.text())), {}
    for entry in packing.entries:
        kind = np.dtype({"u8": "u1", "u16": "<u2", "u32": "<u4", "f32": "<f4"}[entry["kind"]])
        count = int(np.prod(entry["shape"]))
        planes, raw = raw[: count * kind.itemsize], raw[count * kind.itemsize :]
        flat = np.frombuffer(planes, np.uint8).reshape(kind.itemsize, count).T.copy().view(kind)
        found[entry["name"]] = flat.reshape(entry["shape"]) * np.array(entry.get("step", 1)) + entry.get("low", 0)
    assert not raw
    assert np.abs(found["fine"] - values).max(0) == pytest.approx(0, abs=0.51 * np.ptp(values, axis=0).max() / 65535)
    assert np.abs(found["coarse"] - values).max() <= 0.51 * np.ptp(values, axis=0).max() / 255
    np.testing.assert_allclose(found["too wide"], values.astype("f4"))
    np.testing.assert_array_equal(found["whole"], whole)
    assert [e["kind"] for e in packing.entries] == ["u16", "u8", "f32", "u32"]
    with pytest.raises(ValueError, match="whole numbers"):
        packing.whole("below", np.array([-1]))


def test_the_page_allows_its_own_scripts_and_nothing_else(tmp_path):
    export_result(reconstruction(), Page(), tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)[1]
    run = re.findall(r"<script(?: id=\"engine\")?>(.*?)</script>", text, re.DOTALL)
    assert len(run) == 2
    for script in run:
        assert f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" in policy
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy and "http" not in policy
    assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", text)
    assert "@" not in re.sub(r"<script.*?</script>|<style>.*?</style>", "", text, flags=re.DOTALL)


def test_every_script_of_the_folder_is_in_the_page():
    assert sorted((*ENGINE, *PAGE)) == sorted(path.name for path in WEB.glob("*.js"))
    for path in WEB.iterdir():
        assert "</script" not in path.read_text() or path.name == "page.html"


def test_the_size_does_not_grow_with_the_frames(tmp_path):
    sizes = []
    for frames in (48, 480):
        result = reconstruction(frames=frames)
        write_page(tmp_path / "p.html", result, strips_of(footage_like(result)[:2]))
        sizes.append((tmp_path / "p.html").stat().st_size)
    poses = 480 * 16 * 4 * 4 / 3  # of the one camera that moves
    assert abs(sizes[1] - sizes[0]) < poses


def test_fifteen_thousand_gaussians_over_five_seconds_take_less_than_4_mb(tmp_path):
    names = tuple("abcdef")
    result = reconstruction(names=names, frames=150, gaussians=15_000, still=0, seconds=5.0, nodes=900)
    write_page(tmp_path / "p.html", result, strips_of(footage_like(result)))
    assert (tmp_path / "p.html").stat().st_size <= 4e6


def test_strips_are_read_back_and_damaged_ones_are_named(tmp_path):
    strips = strips_of(footage_like(reconstruction()))
    write_strips(tmp_path, strips)
    for a, b in zip(read_strips(tmp_path), strips, strict=True):
        assert (a.name, a.columns, a.size, a.webp) == (b.name, b.columns, b.size, b.webp)
        np.testing.assert_array_equal(a.times, b.times)
    small = strips_of(footage_like(reconstruction()), most_bytes=2000)
    assert sum(len(s.webp) for s in small) < sum(len(s.webp) for s in strips)
    np.savez(tmp_path / "strips.npz", about=np.zeros(3, np.uint8))
    with pytest.raises(ValueError, match=r"strips\.npz: expected strips"):
        read_strips(tmp_path)
    assert read_strips(tmp_path / "none") == ()


def test_names_of_files_are_data_in_the_page(tmp_path):
    export_result(reconstruction(names=HOSTILE), Page(), tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text()
    assert tuple(camera["name"] for camera in about_of(tmp_path / "p.html")["cameras"]) == HOSTILE
    assert "window.hit" in text and "<script>window.hit" not in text and "<img" not in text
    write_page(tmp_path / "q.html", reconstruction(), title=HOSTILE[0], report=HOSTILE[1])
    assert "<script>window.hit" not in (tmp_path / "q.html").read_text()
    assert "<img" not in (tmp_path / "q.html").read_text()


# what a browser shows


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


@pytest.fixture
def opened(browser) -> Iterator[Opened]:
    shown = Opened(browser)
    yield shown
    shown.close()
    assert not shown.complaints
    assert all(url.startswith(("file:", "blob:", "about:")) for url in shown.requests), shown.requests


@pytest.fixture(scope="module")
def scene_page(tmp_path_factory) -> Path:
    result = reconstruction()
    path = tmp_path_factory.mktemp("page") / "scene.html"
    write_page(path, result, strips_of(footage_like(result)), report="report.html")
    return path


@pytest.mark.parametrize(
    "kind, options",
    [
        ("scaffold", {}),
        pytest.param("scaffold", {"layered": False, "degree": 4}, marks=pytest.mark.slow),
        pytest.param("dual", {}, marks=pytest.mark.slow),
        pytest.param("per video", {}, marks=pytest.mark.slow),
        pytest.param("sampled", {"still": 0}, marks=pytest.mark.slow),
        pytest.param("own", {}, marks=pytest.mark.slow),
        pytest.param("static", {"degree": 2}, marks=pytest.mark.slow),
    ],
)
def test_pixels_are_those_of_the_rasterizer(browser, tmp_path, kind, options):
    """Three times and two views, one of a camera that moves; through lenses that lose two thirds in the corners."""
    result = reconstruction(kind, **options)
    dark = Vignetting(-0.8, -0.3)
    result = replace(result, videos=tuple(replace(v, optics=(dark,)) for v in result.videos), optics=(dark,))
    export_result(result, Page(), tmp_path / "p.html")
    shown = Opened(browser, SIZE)
    for name in ("b", "c"):
        video = result.video(name)
        for k in (3, 7, 15):  # the moving camera's own frames, where both have the same pose
            t = float(video.clock.world(video.times[k]))
            seen = shown.open(tmp_path / "p.html", bare=True, camera=name, time=t).picture()
            expected = next(iter(rendered(result, [t], name))).astype(float)
            assert expected.std() > 20
            assert psnr(seen, expected) >= 38, (name, k)
    shown.close()
    assert not shown.complaints


def test_weights_of_splines_are_those_of_the_paths(opened, scene_page):
    opened.open(scene_page)
    splines = [kind(*grid) for kind in (BSpline, HermiteSpline) for grid in ((-0.3, 0.13, 4), (2.0, 0.2, 7))]
    for path in (*splines, Sampled(0.1, 1 / 30, 9)):
        about = {"kind": type(path).__name__, "start": path.start, "spacing": path.spacing, "count": path.count}
        times = np.linspace(path.start - 0.5, path.times[-1] + 0.5, 97)
        code = "([about, times]) => times.map(t => knotWeights(about, t))"
        found = opened.page.evaluate(code, [about, times.tolist()])
        dense = np.zeros((len(times), path.count))
        for row, one in zip(dense, found, strict=True):
            row[one["first"] : one["first"] + 4] = one["weights"]
        np.testing.assert_allclose(dense, path.design(times).toarray(), atol=1e-9)


@pytest.mark.parametrize("kind", MOTIONS)
def test_gaussians_are_where_the_motion_carries_them(opened, tmp_path, kind):
    scene = scene_of(kind)
    export_result(reconstruction(kind), Page(), tmp_path / "p.html")
    opened.open(tmp_path / "p.html")
    code = """async (times) => {
        const { about, arrays } = await readScene();
        prepareCameras(about, arrays);
        const out = new Float32Array(about.row_start * PLACE);
        const motion = motionOf(about, arrays);
        return times.map((t) => (motion.carry(t, out), Array.from(out.subarray(0, about.moving * PLACE))));
    }"""
    times = [0.0, 0.313, 0.8, 1.3]
    middle = scene.moving(0.4).means.double().numpy()
    for t, flat in zip(times, opened.page.evaluate(code, times), strict=True):
        found = np.array(flat).reshape(-1, 8)
        moved = scene.moving(t)
        expected = moved.means.double().numpy() - np.median(middle, 0)
        assert (
            np.abs(found[:, :3] - expected).max() < 0.5 * scene.footprint
        )  # half a pixel, where nodes turn by 30 degrees
        q = torch.nn.functional.normalize(moved.quats, dim=1).numpy()
        r = found[:, 4:] / np.linalg.norm(found[:, 4:], axis=1, keepdims=True)
        assert np.abs((q * r).sum(1)).min() > np.cos(np.radians(1.0) / 2)
    assert np.abs(FAR).max() > 100


def test_time_is_moved_by_slider_keys_and_timeline(opened, scene_page):
    opened.open(scene_page)
    start, frozen = opened.seconds(), opened.picture("#view")
    opened.press(".")
    assert opened.seconds() == pytest.approx(start + 1 / 30, abs=1e-6)
    assert np.abs(opened.picture("#view") - frozen).max() > 20
    opened.press(",")
    np.testing.assert_array_equal(opened.picture("#view"), frozen)  # the same moment is the same picture
    opened.press("Shift+ArrowRight", on="#time")
    assert opened.seconds() == pytest.approx(start + 0.1 / 30, abs=1e-6)
    box = opened.page.locator("#time").bounding_box()
    opened.page.mouse.click(box["x"] + 0.7 * box["width"], box["y"] + box["height"] / 2)
    late = opened.rested().seconds()
    assert late > start + 0.1
    bars = opened.page.locator("#timeline").bounding_box()
    opened.page.mouse.click(bars["x"] + 0.3 * bars["width"], bars["y"] + 8)
    assert opened.rested().seconds() < late - 0.1


def test_play_and_pause_by_key_and_button(opened, scene_page):
    opened.open(scene_page)
    start = opened.seconds()
    opened.page.keyboard.press("Space")
    opened.page.wait_for_function("start => Number(document.getElementById('time').value) > start + 0.02", arg=start)
    assert opened.page.get_attribute("#play", "aria-label") == "Pause"
    opened.page.keyboard.press("Space")
    stood = opened.rested().seconds()
    opened.page.wait_for_timeout(200)
    assert opened.seconds() == stood
    opened.page.select_option("#speed", "1")
    opened.page.click("#play")
    opened.page.wait_for_function("t => Number(document.getElementById('time').value) !== t", arg=stood)
    opened.page.click("#play")
    opened.rested()


def test_cameras_are_chosen_by_key_list_and_picture(opened, scene_page):
    opened.open(scene_page)
    free = opened.picture("#view")
    views = [opened.press("2").picture("#view")]
    assert opened.page.input_value("#camera") == "1"
    opened.page.select_option("#camera", "2")
    views.append(opened.rested().picture("#view"))
    opened.page.click("#videos li:nth-child(1) button")
    views.append(opened.rested().picture("#view"))
    assert opened.page.get_attribute("#videos li:nth-child(1) button", "aria-pressed") == "true"
    for a, b in zip([free, *views], views, strict=False):
        assert psnr(a, b) < 25
    opened.press("0")
    assert opened.page.input_value("#camera") == "-1"
    opened.page.keyboard.press("f")
    opened.page.wait_for_timeout(300)
    assert opened.page.get_attribute("#tour", "aria-pressed") == "true"
    opened.press("Escape")
    assert psnr(opened.picture("#view"), views[-1]) < 40


def test_the_view_is_turned_moved_and_brought_closer(opened, scene_page):
    opened.open(scene_page)
    assert opened.page.locator("#hint").evaluate("hint => getComputedStyle(hint).opacity") == "1"
    opened.page.evaluate("document.getElementById('hint').hidden = true")  # it goes while the view is turned
    before = [opened.picture("#view")]

    def changed() -> None:
        now = opened.rested().picture("#view")
        assert psnr(now, before[-1]) < 35
        before.append(now)

    box = opened.page.locator("#view").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for button in ("left", "right"):
        opened.page.mouse.move(x, y)
        opened.page.mouse.down(button=button)
        opened.page.mouse.move(x + 90, y + 30, steps=4)
        opened.page.mouse.up(button=button)
        changed()
    opened.page.mouse.wheel(0, -300)
    changed()
    opened.page.focus("#view")
    for key in ("ArrowLeft", "Shift+ArrowUp", "-"):
        opened.page.keyboard.press(key)
        opened.page.keyboard.press(key)
        changed()
    opened.page.evaluate("document.activeElement.blur()")  # the ring around what has the focus
    opened.press("h")
    assert psnr(opened.picture("#view"), before[0]) > 40
    assert "known" in (opened.page.get_attribute("#hint", "class") or "")  # whoever has turned the scene needs no hint


def test_clocks_as_filmed_and_synchronised(opened, scene_page):
    """As filmed all videos begin together; synchronised, they show the same moment."""
    opened.open(scene_page, time=0.5)
    tile, bars = "#videos li:nth-child(3) canvas", opened.picture("#timeline")
    before = opened.picture(tile)
    opened.press("c")
    assert opened.page.is_checked("#clocks [value=filmed]")
    assert psnr(opened.picture(tile), before) < 35 and psnr(opened.picture("#timeline"), bars) < 30
    reference = opened.picture("#videos li:nth-child(1) canvas")
    opened.page.click("#clocks label:has([value=synchronised])")
    np.testing.assert_array_equal(opened.rested().picture(tile), before)
    np.testing.assert_array_equal(opened.picture("#videos li:nth-child(1) canvas"), reference)
    own = """([v, t]) => {
        const c = new Clocks(JSON.parse(textOf('about'))), own = c.own(c.cameras[v], t);
        return [own, c.at(c.cameras[v], own), c.shown(c.cameras[v], t)];
    }"""
    shown = opened.page.evaluate(own, [2, 0.5])
    assert shown == pytest.approx([(0.5 - 0.16) / 1.02, 0.5, 0.5])


def test_a_file_whose_own_clock_begins_late_is_as_late_as_its_bar(opened, scene_page):
    """An offset of -.3725 s and a file that begins at .5 s of its clock: .1275 s late, not .3725 early."""
    opened.open(scene_page)
    told = "camera => [offsetWords(camera, 0.02), lateBy(camera, 0.02)]"
    words, late = opened.page.evaluate(told, {"rate": 1, "first": 0.5, "offset": -0.3525, "sigma": 0.0014})
    assert words == "127.5 ± 1.4 ms late" and late == pytest.approx(0.1275)
    words, _ = opened.page.evaluate(told, {"rate": 1, "first": 0, "offset": -0.08, "sigma": None})
    assert words == "100.0 ms early"


def test_it_says_whether_a_frame_is_of_this_instant(opened, scene_page):
    cameras = about_of(scene_page)["cameras"]
    frames = [
        camera["rate"] * (camera["first"] + camera["shots"]["step"] * np.arange(60)) + camera["offset"]
        for camera in cameras
    ]
    apart = [[np.abs(f - t).min() for f in frames] for t in np.linspace(0.4, 0.7, 200)]
    between = float(np.linspace(0.4, 0.7, 200)[int(np.argmax(np.min(apart, 1)))])
    asked = np.array([np.abs(f - between).min() for f in frames])
    assert opened.open(scene_page).page.inner_text("#between").startswith("rendered between frames")
    said = opened.open(scene_page, time=f"{between:.4f}").page.inner_text("#between")
    assert said == (
        f"rendered between frames; the nearest is {1000 * asked.min():.1f} ms away, in video "
        f"{cameras[int(asked.argmin())]['name']}"
    )
    on_a_frame = frames[0][np.abs(frames[0] - 0.5).argmin()]
    said = opened.open(scene_page, time=f"{on_a_frame:.5f}").page.inner_text("#between")
    assert said == f"rendered; video {cameras[0]['name']} has a frame of this instant"
    opened.press("c")
    assert opened.rested().page.inner_text("#between") == "rendered; videos as if all had begun together"
    assert opened.page.inner_text("#videos li:nth-child(3) small") == "offset not applied"


def test_frames_that_come_unevenly_are_told_one_by_one():
    even, uneven = np.arange(30) / 30, np.array([0.0, 0.03, 0.07, 0.08])
    assert _shots(even) == {"step": pytest.approx(1 / 30)}
    assert _shots(uneven) == {"times": uneven.tolist()}
    assert _shots(np.array([0.5])) == {"times": [0.5]}


def test_layers_and_the_video_over_the_rendering(opened, scene_page):
    opened.open(scene_page, time=0.4)
    for key in "bvgtt":  # what stands still, cameras, dots, trajectories of nodes and dense ones
        before = opened.picture(".stage")
        opened.press(key)
        assert np.abs(opened.picture(".stage") - before).max() > 60, key
    assert opened.page.input_value("#paths") == "dense"
    assert opened.page.is_disabled("#blend")
    opened.press("1")
    opened.page.fill("#blend", "1")
    opened.rested()
    box, seen = opened.page.locator(".stage").bounding_box(), opened.picture(".stage")
    scale = min(box["width"] / SIZE[0], box["height"] / SIZE[1])
    x0, y0 = (int((box[side] - scale * n) / 2) for side, n in (("width", SIZE[0]), ("height", SIZE[1])))
    inner = seen[y0 + 60 : int(y0 + scale * SIZE[1]) - 20, x0 + 20 : int(x0 + scale * SIZE[0]) - 60]
    assert inner[..., 0].mean() < 90 and inner[:, -1, 2].mean() > inner[:, 0, 2].mean() + 50  # the filmed gradient


def test_hostile_names_are_inert(opened, tmp_path):
    result = reconstruction(names=HOSTILE)
    write_page(tmp_path / "p.html", result, strips_of(footage_like(result)), title=HOSTILE[0], report=HOSTILE[1])
    opened.open(tmp_path / "p.html")
    assert opened.page.evaluate("window.hit") is None
    assert tuple(opened.page.locator("#videos b").all_text_contents()) == HOSTILE
    assert opened.page.title() == HOSTILE[0]
    opened.press("2")


def test_a_phone_shows_everything_and_is_steered_by_touch(browser, scene_page):
    shown = Opened(browser, (390, 780), has_touch=True, is_mobile=True, device_scale_factor=2)
    shown.open(scene_page)
    assert shown.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    before = shown.picture("#view")
    touch = """(kind, id, x, y) => {
        const more = { bubbles: true, buttons: kind === 'pointermove' ? 1 : 0 };
        part('view').dispatchEvent(new PointerEvent(kind, { pointerId: id, clientX: x, clientY: y, ...more }));
    }"""
    shown.page.evaluate("part('view').setPointerCapture = () => {}")
    for kind, id_, x, y in [
        *(("pointerdown", 1, 150, 200), ("pointerdown", 2, 200, 200)),
        *(("pointermove", 1, 120, 200), ("pointermove", 2, 260, 200)),
        *(("pointerup", 1, 120, 200), ("pointerup", 2, 260, 200)),
    ]:
        shown.page.evaluate(f"([k, i, x, y]) => ({touch})(k, i, x, y)", [kind, id_, x, y])
    assert psnr(shown.rested().picture("#view"), before) < 35
    shown.close()
    assert not shown.complaints


def test_where_a_browser_allows_no_worker_the_page_computes_itself(opened, scene_page):
    expected = opened.open(scene_page, time=0.31).picture("#view")
    opened.page.add_init_script("delete window.Worker")
    np.testing.assert_array_equal(opened.open(scene_page, time=0.31).picture("#view"), expected)


def test_a_scene_without_cameras_is_shown_too(opened, tmp_path):
    write_page(tmp_path / "p.html", scene_of("own"))
    opened.open(tmp_path / "p.html")
    assert opened.picture("#view").std() > 20


def test_a_motion_that_the_page_cannot_evaluate_is_refused(tmp_path):
    class Strange:
        warp = staticmethod(scene_of("static").motion.warp)

    with pytest.raises(ValueError, match="found Strange, which the page cannot evaluate"):
        write_page(tmp_path / "p.html", replace(scene_of("static"), motion=Strange()))
    assert not (tmp_path / "p.html").exists()
