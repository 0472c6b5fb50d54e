"""What a fit begins with: without a scaffold there is none anywhere, and without geometry none is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.types import Offsets
from recon.motion import PerGaussian, ScaffoldOptions
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import Prepared, prepare
from recon.pipeline.starts import FromImages, OnTracks, Start
from recon.scene.seed import Seeding
from tests.recon.worlds import FRAMES, SIZE, capture, write_world

PLAN = Plan(SIZE[0], backdrop_steps=3)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world"))


def begun(world, start: Start, *, tracks=True, depth=True, plan=PLAN) -> Prepared:
    scene = open_scene(world)
    if not depth:
        scene = replace(scene, videos=tuple(replace(v, depth=None) for v in scene.videos))
    given, cache = capture().tracks if tracks else None, Cache(world / "stages")
    truth = Offsets.load(world / "truth.json")
    return prepare(scene, truth, given, plan=plan, held_out=("held0",), start=start, cache=cache)


def forbid(monkeypatch, *names: str) -> None:
    for name in names:

        def refuse(*args, name=name, **options):
            raise AssertionError(f"{name} is not to be used here")

        monkeypatch.setattr(name, refuse)


def test_gaussians_on_tracks_move_as_the_world_does_without_a_scaffold(world, monkeypatch):
    forbid(monkeypatch, "recon.pipeline.starts.build_scaffold", "recon.motion.scaffold.Scaffold.__post_init__")
    ready = begun(world, OnTracks())
    scene, c = ready.initial, capture()
    assert isinstance(scene.motion, PerGaussian) and scene.motion.near is not None and len(scene) > 300
    times = np.arange(FRAMES) / 30
    paths, true = scene.tracks(times), c.world.positions(times)
    middle = FRAMES // 2
    nearest = np.linalg.norm(paths[:, None, middle] - true[None, :, middle], axis=-1).argmin(1)
    moved, wanted = (x - x[:, middle : middle + 1] for x in (paths, true[nearest]))
    error = np.linalg.norm(moved - wanted, axis=-1)
    travelled = np.linalg.norm(wanted, axis=-1)
    assert np.median(error[:, [2, -3]]) < 0.35 * np.median(travelled[:, [2, -3]])


def test_a_start_from_images_asks_for_nothing_else(world, monkeypatch):
    """Neither what moves nor what is static is made with tracks or depth, whether they were given or not."""
    forbid(
        monkeypatch,
        *("recon.pipeline.prepare.lifted_tracks", "recon.pipeline.starts.build_scaffold"),
        *("recon.pipeline.stages.working_depth", "recon.pipeline.starts.working_depth"),
    )
    whole, bare = begun(world, FromImages()), begun(world, FromImages(), tracks=False, depth=False)
    assert whole.tracks == () == bare.tracks and len(whole.initial) > 100
    for name in ("means", "sh"):
        assert torch.equal(getattr(whole.initial.dynamic, name), getattr(bare.initial.dynamic, name))
        assert torch.equal(getattr(whole.initial.static, name), getattr(bare.initial.static, name))


OPTIONS = {
    "scaffold.unit": ScaffoldOptions(unit=20.0),
    "scaffold.second_pick": ScaffoldOptions(second_pick=1.0),
    "scaffold.per_video": ScaffoldOptions(per_video=True),
    "scaffold.neighbours": ScaffoldOptions(neighbours=3),
    "scaffold.spacing": ScaffoldOptions(spacing=0.05),
    "scaffold.margin": ScaffoldOptions(margin=0.5),
    "scaffold.spline": ScaffoldOptions(spline="hermite"),
    "scaffold.robust": ScaffoldOptions(robust=0.2),
}


@pytest.mark.slow
@pytest.mark.parametrize("start", [OnTracks(), FromImages()], ids=["tracks", "images"])
def test_what_a_start_says_that_it_ignores_it_ignores_and_nothing_else(world, start):
    def content(plan: Plan) -> list[bytes]:
        scene = begun(world, start, plan=plan).initial
        return [x.detach().numpy().tobytes() for x in (*vars(scene.dynamic).values(), scene.motion.own_knots)]

    base = content(PLAN)
    for option, scaffold in OPTIONS.items():
        assert (content(replace(PLAN, scaffold=scaffold)) == base) == (option in start.ignores), option
    for name, value in {"support": 3, "reach": 0.5, "voxel": 4.0, "opacity": 0.5}.items():
        seeding = replace(Seeding(), **{name: value})
        assert (content(replace(PLAN, seeding=seeding)) == base) == (f"seeding.{name}" in start.ignores), name
