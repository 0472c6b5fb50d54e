"""Optical flow of what moves alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from otsync.priors.flow import DISFlow
from otsync.priors.patch_flow import SMALL, PatchFlow
from otsync.priors.points import ChainedFlow
from otsync.priors.slots import OfWhatMoves
from otsync.priors.working import WorkingFrames


def textured(seed: int, *shape: int) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 255, shape).astype(np.float32), (0, 0), 2)


def moved(motion, size=(240, 320), thing=60) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two grey images in which a textured square has moved over a still, textured ground, and its mask in both."""
    ground, square = textured(0, *size), textured(1, thing, thing)
    out = []
    for dx, dy in ((0, 0), motion):
        image, mask = 0.3 * ground, np.zeros(size, bool)
        here = np.s_[100 + dy : 100 + dy + thing, 60 + dx : 60 + dx + thing]
        image[here], mask[here] = 80 + square, True
        out += [np.clip(image, 0, 255).astype(np.uint8), mask]
    return out[0], out[2], out[1], out[3]


def flows(flow, before, after, here, there):
    return flow.between(flow.prepare(before, here), flow.prepare(after, there))


@pytest.mark.parametrize("motion", [(5, 2), (-3, 0), (21, -14), (40, 30)])
def test_what_moves_is_found_there_and_back_far_beyond_a_patch(motion):
    before, after, here, there = moved(motion)
    ahead, back = flows(PatchFlow(), before, after, here, there)
    assert ahead.shape == back.shape == (120, 160, 2)
    x, y = motion
    inner = np.s_[53:77, 33:57]
    inner_after = np.s_[53 + y // 2 : 77 + y // 2, 33 + x // 2 : 57 + x // 2]
    assert np.median(np.abs(ahead[inner] - motion)) < 0.1
    assert np.median(np.abs(back[inner_after] + motion)) < 0.1


def test_far_from_what_moves_there_is_no_flow():
    before, after, here, there = moved((5, 2))
    ahead, back = flows(PatchFlow(), before, after, here, there)
    assert not ahead[:, 125:].any() and not back[:, 125:].any()
    nothing = np.zeros_like(here)
    assert not any(f.any() for f in flows(PatchFlow(), before, after, nothing, nothing))


def test_the_way_back_is_the_way_there_of_exchanged_frames():
    before, after, here, there = moved((5, 2))
    ahead, back = flows(PatchFlow(), before, after, here, there)
    back2, ahead2 = flows(PatchFlow(), after, before, there, here)
    assert np.array_equal(ahead, ahead2) and np.array_equal(back, back2)


def test_light_that_changes_everywhere_changes_little():
    before, after, here, there = moved((5, 2))
    darker = (0.9 * after.astype(float) + 7).astype(np.uint8)
    ahead, _ = flows(PatchFlow(), before, darker, here, there)
    assert np.median(np.abs(ahead[53:77, 33:57] - [5, 2])) < 0.1


def turned(angle: float, stretch: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A textured image, the same turned and stretched about its middle, and the flow from one to the other."""
    image = textured(2, 240, 320)
    M = cv2.getRotationMatrix2D((160, 120), angle, stretch)
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    to = np.stack([x, y, np.ones_like(x)], -1) @ M.T
    after = cv2.warpAffine(image, M, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    flow = (to - np.stack([x, y], -1)).astype(np.float32)
    return *(np.clip(i, 0, 255).astype(np.uint8) for i in (image, after)), flow


@pytest.mark.parametrize("angle, stretch", [(1.5, 1.0), (4.0, 1.02)])
def test_known_flows_are_found_as_well_as_by_the_flow_of_the_whole_image(angle, stretch):
    before, after, true = turned(angle, stretch)
    here = np.zeros((240, 320), bool)
    here[60:180, 80:240] = True
    small = cv2.resize(true, (160, 120), interpolation=cv2.INTER_AREA)[34:86, 44:116]
    ours = flows(PatchFlow(), before, after, here, here)[0][34:86, 44:116]
    whole = cv2.resize(DISFlow().pair(before, after)[0], (160, 120), interpolation=cv2.INTER_AREA)[34:86, 44:116]
    error, theirs = (np.median(np.linalg.norm(f - small, axis=-1)) for f in (ours, whole))
    assert error < 0.1 and error < 1.2 * theirs + 0.01


def test_refinement_makes_the_flow_agree_with_itself():
    before, after, here, there = moved((5, 2))
    noise = np.random.default_rng(3).normal(0, 6, (2, *before.shape))
    before, after = (np.clip(i + n, 0, 255).astype(np.uint8) for i, n in zip((before, after), noise, strict=True))
    inner = np.s_[53:77, 33:57]
    rough = flows(PatchFlow(rounds=0), before, after, here, there)[0][inner]
    fine = flows(PatchFlow(), before, after, here, there)[0][inner]
    assert np.linalg.norm(fine - [5, 2], axis=-1).mean() < 0.8 * np.linalg.norm(rough - [5, 2], axis=-1).mean()
    assert fine.std((0, 1)).max() < rough.std((0, 1)).max()


def test_a_refined_flow_lowers_what_is_minimised():
    """The robust sums of grey levels, slopes and smoothness, of the linear model about the flow that it began with."""
    from otsync.priors.kernels_flow import PAD, PLANES, refine

    before, after, here, there = moved((1, 0))
    one, other = PatchFlow().prepare(before, here)[0], PatchFlow().prepare(after, there)[0]
    h, w = one.size
    stride = w + 2 * PAD
    rng = np.random.default_rng(0)
    U, V = rng.normal(0, 0.3, (2, len(one.gray))).astype(np.float32) * one.inside
    known = np.ones_like(U)
    cut = np.s_[: (h + 2 * PAD) * stride]

    def energy(U, V):
        u, v, I, J, inside = (x[cut].reshape(-1, stride) for x in (U, V, one.gray, other.gray, one.inside))
        y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
        moved = cv2.remap(J.copy(), x + u, y + v, cv2.INTER_LINEAR)
        gray = np.sqrt((moved - I) ** 2 + 1e-6)
        rough = sum(np.diff(f, axis=a, append=0) ** 2 for f in (u, v) for a in (0, 1))
        edge = inside * np.roll(inside, -1, 0) * np.roll(inside, -1, 1)
        return float((inside * gray).sum()), float((edge * np.sqrt(rough + 1e-6)).sum())

    start = energy(U, V)
    planes = np.empty((PLANES, len(U)), np.float32)
    strengths = (np.float32(15), np.float32(2.5), np.float32(5))
    where = (one.first, one.odd, one.inside)
    refine(one.gray, other.gray, h, w, *where, U, V, known, planes, 5, 5, *strengths)
    end = energy(U, V)
    assert end[0] < 0.6 * start[0] and end[1] < 0.3 * start[1]
    assert not U[one.inside == 0].any() and not V[one.inside == 0].any()


@pytest.mark.parametrize("size", [(9, 30), (40, 17), (33, 65), (241, 319)])
def test_images_of_any_size(size):
    image = textured(4, *size).astype(np.uint8)
    every = np.ones(size, bool)
    for flow in flows(PatchFlow(), image, image, every, every):
        assert flow.shape == ((max(8, size[0]), max(8, size[1]), 2) if min(size) < SMALL else (120, 159, 2))
        assert np.abs(flow).max() < 0.05
    there, back = PatchFlow().pair(image, image)
    assert there.shape == back.shape == (*size, 2)


@pytest.mark.parametrize(
    "wrong", [{"stride": 0}, {"steps": 0}, {"sweeps": 0}, {"rounds": -1}, {"smooth": 0.0}, {"grey": -1.0}]
)
def test_what_cannot_be_is_refused_by_name(wrong):
    with pytest.raises(ValueError, match=f"PatchFlow.{next(iter(wrong))}"):
        PatchFlow(**wrong)


def film(frames=12) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A textured square that moves by (4, 2) a frame, and its masks."""
    ground, thing = textured(0, 240, 320), textured(1, 60, 60)
    images, masks = [], []
    for k in range(frames):
        x, y = 40 + 4 * k, 90 + 2 * k
        image, mask = 0.3 * ground, np.zeros((240, 320), bool)
        image[y : y + 60, x : x + 60] = 80 + thing
        mask[y : y + 60, x : x + 60] = True
        images.append(np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, 2))
        masks.append(mask)
    return images, masks


@pytest.mark.parametrize("flow", [PatchFlow(), DISFlow()])
def test_tracks_go_where_things_go(flow):
    images, masks = film()
    uv = ChainedFlow(flow=flow)(WorkingFrames(images, (320, 240)), masks, 30.0)
    whole = uv[np.isfinite(uv[..., 0]).all(1)]
    assert len(whole) > 20
    assert np.median(np.abs((whole[:, -1] - whole[:, 0]) - [44, 22])) < 0.5


class Told:
    """A flow of pairs that says what it is given."""

    def __init__(self, colour: bool):
        self.colour, self.shapes = colour, []

    def pair(self, before, after):
        self.shapes += [before.shape, after.shape]
        return (np.full((*before.shape[:2], 2), (4, 2), np.float32), np.full((*before.shape[:2], 2), (-4, -2), "f"))


@pytest.mark.parametrize("colour", [False, True])
def test_another_flow_gets_whole_images_and_is_followed(colour):
    images, masks = film()
    told = Told(colour)
    assert not isinstance(told, OfWhatMoves) and isinstance(PatchFlow(), OfWhatMoves)
    uv = ChainedFlow(flow=told)(WorkingFrames(images, (320, 240)), masks, 30.0)
    assert set(told.shapes) == {(240, 320, 3) if colour else (240, 320)} and len(told.shapes) == 22
    whole = uv[np.isfinite(uv[..., 0]).all(1)]
    assert len(whole) > 20 and np.allclose(whole[:, -1] - whole[:, 0], [44, 22])
