"""Points that other programs found, read as these programs write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from otsync.io.keypoints import KEYPOINTS, Detections, read_detections


def read(*files: Path) -> Detections:
    return read_detections(files, KEYPOINTS)


def told(found: Detections) -> set[tuple]:
    return {
        (int(k), found.names[p], int(w), *map(float, xy))
        for k, p, w, xy in zip(found.frame, found.part, found.who, found.xy, strict=True)
    }


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_deeplabcut_of_one_animal_and_of_two(tmp_path):
    one = write(
        tmp_path,
        "one.csv",
        "scorer,DLC,DLC,DLC,DLC,DLC,DLC\nbodyparts,nose,nose,nose,tail,tail,tail\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,1.5,2,0.9,3,4,0.1\n1,5,6,0.8,,,\n",
    )
    found = read(one)
    assert told(found) == {(0, "nose", 0, 1.5, 2), (0, "tail", 0, 3, 4), (1, "nose", 0, 5, 6)}
    assert told(found.surer(0.3)) == {(0, "nose", 0, 1.5, 2), (1, "nose", 0, 5, 6)}
    two = write(
        tmp_path,
        "two.csv",
        "scorer,D,D,D,D,D,D\nindividuals,a,a,a,b,b,b\nbodyparts,nose,nose,nose,nose,nose,nose\n"
        "coords,x,y,likelihood,x,y,likelihood\nlabeled/img07.png,1,2,1,3,4,1\n",
    )
    assert told(read(two)) == {(0, "nose", 0, 1, 2), (0, "nose", 1, 3, 4)}


def test_sleap_and_plain_tables(tmp_path):
    sleap = write(
        tmp_path,
        "s.csv",
        "track,frame_idx,instance.score,head.x,head.y,head.score\nt0,3,.9,1,2,.8\nt1,3,.9,5,6,.7\n,4,.9,7,8,.6\n",
    )
    assert told(read(sleap)) == {(3, "head", 0, 1, 2), (3, "head", 1, 5, 6), (4, "head", -1, 7, 8)}
    table = write(tmp_path, "t.csv", "y;x;Frame;particle\n1;2;0;7\n3;4;1;7\n5;6;1;9\n")
    assert told(read(table)) == {(0, "", 0, 2, 1), (1, "", 0, 4, 3), (1, "", 1, 6, 5)}


def test_openpose_takes_the_frame_from_the_name(tmp_path):
    person = {"person_id": [-1], "pose_keypoints_2d": [10, 20, 0.9, 0, 0, 0] + [0] * 69, "face_keypoints_2d": []}
    for k in (0, 2):
        write(tmp_path, f"v_{k:012d}_keypoints.json", json.dumps({"version": 1.3, "people": [person]}))
    found = read(*sorted(tmp_path.glob("*.json")))
    assert told(found) == {(0, "nose", -1, 10, 20), (2, "nose", -1, 10, 20)}


def test_coco_as_data_set_and_as_results(tmp_path):
    images = [{"id": 11, "file_name": "f_10.jpg"}, {"id": 12, "file_name": "f_9.jpg"}]
    kinds = [{"id": 1, "name": "bat"}, {"id": 2, "name": "person", "keypoints": ["nose", "tail"]}]
    annotations = [
        {"image_id": 11, "category_id": 1, "bbox": [10, 20, 4, 2], "track_id": 5},
        {"image_id": 12, "category_id": 2, "keypoints": [1, 2, 2, 0, 0, 0]},
    ]
    path = write(tmp_path, "c.json", json.dumps({"images": images, "annotations": annotations, "categories": kinds}))
    assert told(read(path)) == {(1, "bat", 0, 12, 21), (0, "nose", -1, 1, 2)}
    results = [{"image_id": "7.jpg", "category_id": 1, "keypoints": [3, 4, 0.5], "score": 0.9}]
    assert told(read(write(tmp_path, "r.json", json.dumps(results)))) == {(7, "point_0", -1, 3, 4)}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "frame,x,y\n0,1,two\n", "row 2, y: expected a number; found 'two'"),
        ("a.csv", "frame,x,y\n0.5,1,2\n", "row 2, frame: expected a whole number"),
        ("a.csv", "frame,x,y\n0,1\n", "row 2: expected 3 columns; found 2"),
        ("a.csv", "frame,x,y\n", "expected points; found none"),
        ("a.csv", "time,left,top\n0,1,2\n", "expected points as a reader knows them"),
        ("a.json", '{"people": []}', "expected points; found none"),
        ("a.json", '{"people": [{"pose_keypoints_2d": [1, 2]}]}', "expected a list of x, y, confidence"),
        ("a.json", '[{"image_id": "none", "bbox": [1, 2, 3, 4]}]', "expected the number of a frame"),
        ("a.json", '[{"image_id": 1, "bbox": 3}]', "expected image_id, keypoints or bbox"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, name, text, words):
    path = write(tmp_path, name, text)
    with pytest.raises(ValueError, match=words) as error:
        read(path)
    assert name in str(error.value)


def test_frames_that_are_left_move_their_points():
    found = Detections.of([(0, 1.0, 1.0, "a", 0, 1.0), (4, 2.0, 2.0, "a", 0, 1.0), (6, 3.0, 3.0, "a", 0, np.nan)])
    assert found.within([4, 6]).frame.tolist() == [0, 1]
    assert found.surer(0.5).frame.tolist() == [0, 4]
