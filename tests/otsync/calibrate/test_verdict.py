"""Each reason to doubt a camera, and two mappers that agree in part only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync.calibrate.clips import pinhole
from otsync.calibrate.found import WALK, FoundCamera
from otsync.calibrate.mapping import Model
from otsync.calibrate.verdict import FEW_INLIERS, agreement, judged, spread, support
from otsync.calibrate.world import centres
from tests.otsync.calibrate.test_world import similar
from tests.recording_world import H, W, ring

SOUND = {"turn": 0.1, "move": 0.01, "whole": True, "checked": True, "health": 0.95}


def camera(**more) -> FoundCamera:
    lens = pinhole(500.0, (640, 360), "found")
    told = {"w2c": np.eye(4), "inliers": 200} | more
    return FoundCamera("left", 640, 360, lens.K, None, told.pop("lens", "found"), **told)


def test_a_sound_camera_is_trusted():
    assert judged(camera(), **SOUND).ok


@pytest.mark.parametrize(
    ("about", "verdict", "words"),
    [
        ({"w2c": None}, {}, "no background in common"),
        ({"inliers": FEW_INLIERS - 1}, {}, "49 matches"),
        ({}, {"turn": np.nan}, "leaves it out"),
        ({}, {"turn": np.nan, "checked": False}, "makes no model"),
        ({}, {"turn": 2.5}, "2.5 degrees"),
        ({}, {"move": 0.2}, "20 % of its distance"),
        ({}, {"whole": False}, "different models of the whole"),
        ({}, {"health": 0.3}, "70 % of the matches of left contradict"),
        ({"lens": "guessed"}, {}, "is a guess"),
        ({"bridged": 0.3}, {}, "30 % of the frames"),
    ],
)
def test_each_reason_is_named_with_what_to_do(about, verdict, words):
    found = judged(camera(**about), **(SOUND | verdict))
    assert not found.ok and words in found.doubt and found.remedy
    if about.get("w2c", "there") is None:
        assert found.remedy == WALK
        assert judged(camera(**about), **(SOUND | verdict), helped=True).remedy != WALK


def model(w2c: np.ndarray, pictures: list[int] | None = None) -> Model:
    n = len(w2c)
    rest = np.zeros((0, 3)), np.zeros((0, 2), int), np.zeros((0, 2))
    return Model(np.array(pictures or range(n)), w2c, np.full(n, 0.8 * W), np.zeros(n), *rest, 0.5)


def test_mappers_agree_up_to_a_similarity():
    w2c = np.stack([c.w2c for c in ring(6)])
    found = agreement(model(w2c), model(similar(1).camera(w2c)), np.arange(6), 6)
    assert found.whole and found.turn.max() < 1e-3 and found.move.max() < 1e-3


def test_half_of_a_symmetric_room_turned_confirms_nothing():
    """A dome of 72 degrees: one mapper turns three of six cameras by a step. None of them is confirmed."""
    w2c = np.stack([c.w2c for c in ring(6)])
    angle = np.radians(72)
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    other = w2c.copy()
    other[3:] = w2c[3:] @ turn
    assert not agreement(model(w2c), model(other), np.arange(6), 6).whole
    one = w2c.copy()
    one[5] = w2c[5] @ turn
    found = agreement(model(w2c), model(one), np.arange(6), 6)
    assert found.whole and found.turn[5] > 60 and found.turn[:5].max() < 0.5


def test_a_video_that_one_mapper_lacks_is_not_compared():
    w2c = np.stack([c.w2c for c in ring(5)])
    found = agreement(model(w2c), model(w2c[:4]), np.arange(5), 5)
    assert np.isnan(found.turn[4]) and np.isfinite(found.turn[:4]).all()
    assert not agreement(model(w2c), None, np.arange(5), 5).whole
    assert not agreement(model(w2c[:2]), model(w2c[:2]), np.arange(5), 5).whole  # two can always be laid over


def test_two_halves_tell_how_sure_the_whole_is():
    """Poses from half of the points scatter by sqrt 2 of the whole's deviation each: they are drawn so here."""
    w2c, rng, sigma, size = np.stack([c.w2c for c in ring(40)]), np.random.default_rng(0), 0.2, 0.02
    halves = []
    for world in (similar(0), similar(1)):
        turned = w2c.copy()
        for pose in turned:
            vector = np.radians(np.sqrt(2) * sigma) * rng.normal(size=3) / np.sqrt(3)
            place = centres(pose) + np.sqrt(2) * size * rng.normal(size=3) / np.sqrt(3)
            pose[:3, :3] = Rotation.from_rotvec(vector).as_matrix() @ pose[:3, :3]
            pose[:3, 3] = -pose[:3, :3] @ place
        halves.append(world.camera(turned))
    of = np.arange(40) // 4
    turn, move = spread(replace(model(w2c), halves=np.stack(halves)), of, 10)
    assert np.sqrt(np.mean(turn**2)) == pytest.approx(sigma, rel=0.25)
    assert np.sqrt(np.mean(move**2)) == pytest.approx(size, rel=0.25)
    assert np.isnan(spread(model(w2c), of, 10)[0]).all()


def test_matches_tell_a_camera_in_a_wrong_place():
    cameras = ring(4)
    w2c = np.stack([c.w2c for c in cameras])
    x = np.random.default_rng(0).uniform(-1, 1, (60, 1, 3))
    uv = [c.project(x)[:, 0] for c in cameras]
    matches = {(a, b): np.concatenate([uv[a], uv[b]], 1) for a in range(4) for b in range(a + 1, 4)}
    lenses = [pinhole(0.8 * W, (W, H), "given")] * 4
    right = support(model(w2c), matches, np.arange(4), lenses)
    assert (right.health == 1).all() and right.nearest.tolist() == [60] * 4
    wrong = w2c.copy()
    wrong[2] = w2c[2] @ np.diag([-1.0, 1, -1, 1])
    spoilt = support(model(wrong), matches, np.arange(4), lenses)
    assert spoilt.health[2] < 0.5 and spoilt.worth < right.worth
    assert support(None, matches, np.arange(4), lenses).worth == 0
