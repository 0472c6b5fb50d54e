"""Masks as segmenters write them: each form against the masks it was made from, and malformed files with the remedy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from otsync.io.images import read_mask
from otsync.io.masks import read_masks
from otsync.io.masks.run_lengths import decoded, unpacked
from otsync.io.scene import open_scene
from otsync.recordings.tracking import Tracking

H, W, T = 24, 40, 5


@pytest.fixture
def who() -> np.ndarray:
    """(T,H,W) numbers of instances: three things that move, the third of the number 700."""
    out = np.zeros((T, H, W), np.uint16)
    for k in range(T):
        out[k, 2:9, 3 + k : 10 + k] = 1
        out[k, 12:20, 20 - k : 26 - k] = 2
        out[k, 4:12, 28:33] = 700
    return out


def runs(mask: np.ndarray) -> list[int]:
    """Run lengths down the columns, by hand."""
    out, value, count = [], False, 0
    for pixel in mask.T.ravel():
        if pixel != value:
            out.append(count)
            value, count = pixel, 0
        count += 1
    return [*out, count]


def packed(numbers: list[int]) -> str:
    """pycocotools' text of run lengths (rleToString of maskApi.c)."""
    out = ""
    for i, n in enumerate(numbers):
        x = n - numbers[i - 2] if i > 2 else n
        more = True
        while more:
            c = x & 0x1F
            x >>= 5
            more = x != -1 if c & 0x10 else x != 0
            out += chr((c | 0x20 if more else c) + 48)
    return out


def region(mask: np.ndarray, text: bool = False) -> dict[str, Any]:
    return {"size": [H, W], "counts": packed(runs(mask)) if text else runs(mask)}


def images(folder: Path, values: np.ndarray, mode: str = "") -> list[Path]:
    folder.mkdir(exist_ok=True)
    out = []
    for k, own in enumerate(values):
        picture = Image.fromarray(own)
        if mode == "P":
            picture = Image.fromarray(own.astype(np.uint8), mode="P")
            picture.putpalette([n for c in range(256) for n in (37 * c % 256, 91 * c % 256, 17 * c % 256)])
        out.append(folder / f"{k:03d}.png")
        picture.save(out[-1])
    return out


def test_label_images_of_8_and_16_bits_and_palettes(who, tmp_path):
    small = np.where(who == 700, 3, who).astype(np.uint8)
    for files in (images(tmp_path / "a", small), images(tmp_path / "b", who), images(tmp_path / "c", small, "P")):
        found = read_masks(files, "labels")
        np.testing.assert_array_equal(np.stack(list(found)), who > 0)
    chosen = read_masks(images(tmp_path / "b", who), "labels", [1, 700])
    np.testing.assert_array_equal(np.stack(list(chosen)), (who == 1) | (who == 700))
    assert chosen.digest() != read_masks(images(tmp_path / "b", who), "labels").digest()


def test_plain_masks_of_numbers_are_not_misread(who, tmp_path):
    """Half of the largest number would drop the first instances in silence."""
    small = np.where(who == 700, 3, who).astype(np.uint8)
    for file in images(tmp_path / "palette", small, "P") + images(tmp_path / "wide", who):
        assert read_mask(file).any()
        np.testing.assert_array_equal(read_mask(file), who[int(file.stem)] > 0)
    with pytest.raises(ValueError, match=r"expected a mask of two values; found 0, 1, 2, 3.*\"kind\": \"labels\""):
        read_mask(images(tmp_path / "grey", small)[0])
    np.save(tmp_path / "numbers.npy", small[0])
    with pytest.raises(ValueError, match="look like numbers of instances"):
        read_mask(tmp_path / "numbers.npy")
    soft = np.linspace(0, 1, H * W).reshape(H, W)
    np.save(tmp_path / "soft.npy", soft)  # scores are no numbers of instances
    np.testing.assert_array_equal(read_mask(tmp_path / "soft.npy"), soft > 0.5)
    for top in (1, 255):
        file = images(tmp_path / "black", (who > 0).astype(np.uint8) * top)[0]
        np.testing.assert_array_equal(read_mask(file), who[0] > 0)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_stacks_of_numbers_and_of_instances(who, suffix, tmp_path):
    def saved(array: np.ndarray, name: str) -> Path:
        if suffix == ".npy":
            np.save(tmp_path / f"{name}.npy", array)
        else:
            np.savez_compressed(tmp_path / f"{name}.npz", masks=array, scores=np.ones(3))
        return tmp_path / f"{name}{suffix}"

    np.testing.assert_array_equal(np.stack(list(read_masks(saved(who, "who"), None))), who > 0)
    np.testing.assert_array_equal(np.stack(list(read_masks(saved(who, "who"), "stack", [2]))), who == 2)
    each = np.stack([who == n for n in (1, 2, 700)], 1)
    np.testing.assert_array_equal(np.stack(list(read_masks(saved(each, "each"), None))), who > 0)
    np.testing.assert_array_equal(read_masks([saved(who[2], "one")], None)[0], who[2] > 0)
    with pytest.raises(ValueError, match="ids: expected an array"):
        read_masks(saved(each, "each"), None, [1])
    with pytest.raises(ValueError, match="ids: expected numbers to choose from"):
        read_masks(saved(who > 0, "yes"), None, [1])[0]


@pytest.mark.parametrize("text", [False, True])
def test_run_lengths_of_a_file_a_frame_and_of_a_whole_video(who, text, tmp_path):
    ids = (1, 2, 700)
    frames = []
    for k in range(T):
        told = {
            "image": {"height": H, "width": W},
            "annotations": [{"segmentation": region(who[k] == n, text)} for n in ids],
        }
        frames.append(tmp_path / f"{k}.json")
        frames[-1].write_text(json.dumps(told))
    np.testing.assert_array_equal(np.stack(list(read_masks(frames, None))), who > 0)

    order = [3, 0, 4, 1, 2]  # images of a data set come in any order: their names tell
    coco = {
        "images": [{"id": 10 + k, "file_name": f"frame{k + 8}.jpg", "height": H, "width": W} for k in order],
        "annotations": [
            {"image_id": 10 + k, "segmentation": region(who[k] == n, text)} for k in order for n in ids if k != 2
        ],
    }
    (tmp_path / "coco.json").write_text(json.dumps(coco))
    found = np.stack(list(read_masks(tmp_path / "coco.json", None)))
    np.testing.assert_array_equal(found[[0, 1, 3, 4]], who[[0, 1, 3, 4]] > 0)
    assert not found[2].any() and found.shape == (T, H, W)

    tracks = [
        {"video_id": 1, "segmentations": [None if k == 2 and n == 2 else region(who[k] == n, text) for k in range(T)]}
        for n in ids
    ]
    (tmp_path / "vis.json").write_text(json.dumps({"annotations": tracks}))
    found = np.stack(list(read_masks(tmp_path / "vis.json", "coco")))
    np.testing.assert_array_equal(found[[0, 1, 3, 4]], who[[0, 1, 3, 4]] > 0)
    np.testing.assert_array_equal(found[2], (who[2] > 0) & (who[2] != 2))


def test_packed_runs_are_read_as_pycocotools_packs_them():
    rng = np.random.default_rng(0)
    for _ in range(50):
        numbers = rng.integers(0, 10 ** rng.integers(1, 7), rng.integers(1, 40)).tolist()
        assert unpacked(packed(numbers), Path()) == numbers
    mask = rng.random((H, W)) < 0.4
    np.testing.assert_array_equal(decoded(packed(runs(mask)), (H, W), Path()), mask)
    assert not decoded([H * W], (H, W), Path()).any() and decoded([0, H * W], (H, W), Path()).all()


def one(**fields: Any) -> dict[str, Any]:
    return {"annotations": [{"segmentation": {"size": [H, W], "counts": [H * W], **fields}}]}


@pytest.mark.parametrize(
    "document, says",
    [
        ([], "expected an object with annotations; found list"),
        ({"annotations": 3}, "annotations: expected a list"),
        ({"annotations": [{"segmentation": [[1, 2, 3, 4, 5, 6]]}]}, "found polygons. Convert them"),
        ({"annotations": [{"segmentation": {"size": [H, W]}}]}, "expected size and counts"),
        (one(size=[H]), "size: expected .height, width."),
        (one(size=[-1, 4]), "size: expected .height, width."),
        (one(size=[10**6, 10**6], counts=[10**12]), "size: expected at most"),
        (one(counts=[3]), "counts: expected runs of 960 pixels in all"),
        (one(counts=[10**15]), "counts: expected runs of 960 pixels in all"),
        (one(counts=[-5, H * W + 5]), "counts: expected whole numbers or packed text"),
        (one(counts="\u00e9\u00e9"), "expected text as pycocotools packs it"),
        (one(counts="oooooooooooo"), "expected text as pycocotools packs it"),
        (one(counts="T"), "ends within one"),
        ({"annotations": [*one()["annotations"], *one(size=[W, H])["annotations"]]}, "expected one size"),
        ({"annotations": []}, "found none"),
    ],
)
def test_malformed_run_lengths_are_refused_with_file_and_field(document, says, tmp_path):
    (tmp_path / "0.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=says) as refused:
        read_masks([tmp_path / "0.json"], None)[0]
    assert "0.json" in str(refused.value)


@pytest.mark.parametrize(
    "document, says",
    [
        ({"annotations": [], "images": []}, "images: expected one a frame"),
        ({"annotations": [], "images": [{"id": 1}, {"id": 1}]}, "images: expected one a frame with an id each"),
        ({"annotations": [{"image_id": 7}], "images": [{"id": 1}]}, r"annotations\[0\].image_id: expected the id"),
        ({"annotations": [], "images": [{"id": 1}]}, "expected run lengths; found none of any frame"),
        (
            {"annotations": [{"video_id": 1, "segmentations": []}, {"video_id": 2, "segmentations": []}]},
            "expected segmentations of one video",
        ),
        (
            {"annotations": [{"video_id": 1, "segmentations": [None]}, {"video_id": 1, "segmentations": []}]},
            "expected segmentations of one video",
        ),
    ],
)
def test_malformed_files_of_a_video_are_refused(document, says, tmp_path):
    (tmp_path / "all.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=says):
        read_masks(tmp_path / "all.json", None)


def test_malformed_stacks_are_refused(tmp_path):
    def says(array: np.ndarray, text: str) -> None:
        np.save(tmp_path / "masks.npy", array)
        with pytest.raises(ValueError, match=text):
            read_masks(tmp_path / "masks.npy", None)

    says(np.zeros((3, 4, 5)), "true and false or whole numbers; found float64.*above 0")
    says(np.zeros((4, 5), bool), r"expected masks \(T,H,W\) or \(T,N,H,W\)")
    says(np.zeros((0, 4, 5), bool), r"found bool of \(0, 4, 5\)")
    (tmp_path / "masks.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr': '|b1', 'fortran_order': False, 'shape': ")
    with pytest.raises(ValueError, match=r"expected a plain \.npy array"):
        read_masks(tmp_path / "masks.npy", None)
    np.savez(tmp_path / "masks.npz", a=np.zeros(3), b=np.zeros(3))
    with pytest.raises(ValueError, match="expected one array, or one named 'masks'; found a, b"):
        read_masks(tmp_path / "masks.npz", None)


def test_a_claim_of_more_memory_than_is_allowed_is_refused_before_it_is_taken(tmp_path):
    """A header of gigabytes over a few bytes."""
    import zipfile

    header = b"{'descr': '|b1', 'fortran_order': False, 'shape': (100000, 8000, 8000), }"
    member = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n"
    with zipfile.ZipFile(tmp_path / "masks.npz", "w") as archive:
        archive.writestr("masks.npy", member)
    with pytest.raises(ValueError, match=r"masks\.npz"):
        read_masks(tmp_path / "masks.npz", None)


def scene(folder: Path, masks: Any) -> Path:
    """A recording of one video with such masks."""
    images(folder / "left", np.random.default_rng(0).integers(0, 255, (T, H, W, 3), dtype=np.uint8))
    camera = {"K": [[40, 0, 20], [0, 40, 12], [0, 0, 1]], "w2c": np.eye(4).tolist(), "width": W, "height": H}
    video = {"name": "left", "frames": "left/*.png", "fps": 30, "camera": camera, "masks": masks}
    (folder / "scene.json").write_text(json.dumps({"format": "otsync.scene", "version": 1, "videos": [video]}))
    return folder


def test_scene_json_takes_every_form_and_tracking_uses_it(who, tmp_path):
    images(tmp_path / "who", who)
    np.save(tmp_path / "who.npy", who)
    for told in ({"frames": "who/*.png", "kind": "labels", "ids": [2]}, {"file": "who.npy", "ids": [2]}):
        opened = open_scene(scene(tmp_path, told))
        np.testing.assert_array_equal(np.stack(list(opened.masks[0])), who == 2)
        used = Tracking().masks(opened.videos[0], opened.masks[0])
        np.testing.assert_array_equal(np.stack(list(used)), who == 2)


@pytest.mark.parametrize(
    "told, says",
    [
        ({"kind": "labels"}, "either 'frames'.*or 'file'"),
        ({"frames": "left/*.png"}, r"masks.kind: expected one of binary, labels for 000.png; found none"),
        ({"frames": "left/*.png", "kind": "coco"}, r"masks.kind: expected files .json for 'coco'; found 000.png"),
        ({"frames": "left/*.png", "kind": "sam"}, "masks.kind"),
        ({"frames": "left/*.png", "kind": "binary", "ids": [1]}, "masks.ids: expected them beside labels or stack"),
        ({"frames": "left/*.png", "kind": "labels", "ids": []}, "masks.ids"),
        ({"frames": "left/*.png", "kind": "labels", "id": 1}, "masks.id"),
        ({"file": "left/000.png", "kind": "labels"}, "expected 'frames' for images"),
        ({"file": "../who.npy"}, "points outside"),
        ({"file": "short.npy"}, "masks: expected 5 files, one a frame; found 2"),
    ],
)
def test_scene_json_refuses_what_it_cannot_read(told, says, tmp_path):
    np.save(tmp_path / "short.npy", np.ones((2, H, W), bool))
    with pytest.raises(ValueError, match=says):
        open_scene(scene(tmp_path, told))
