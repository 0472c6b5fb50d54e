"""Documents against their schema: types are not converted, keys are known, errors name the field."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from otsync import Offsets
from otsync.files.arrays import read_json
from otsync.files.strict import checked, fields_of, shown
from otsync.io.layout import SceneFile
from otsync.io.schemas import SCHEMAS
from tests.docs.pages import ROOT

CAMERA = {"K": [[9.0, 0, 8], [0, 9, 6], [0, 0, 1]], "w2c": np.eye(4).tolist(), "width": 16, "height": 12}


def scene(**video):
    entry = {"name": "left", "frames": "left/*.png", "fps": 30, "camera": CAMERA}
    return {"format": "otsync.scene", "version": 1, "videos": [entry | video]}


def refused(document) -> str:
    with pytest.raises(ValueError) as caught:
        checked(document, SceneFile, "scene.json")
    text = str(caught.value)
    assert text.startswith("scene.json: ") and text.isprintable()
    return text


def test_a_sound_document_becomes_what_its_schema_says():
    found = checked(scene(timestamps=[0, 0.5]), SceneFile, "scene.json")
    assert found.videos[0].timestamps == [0.0, 0.5] and found.frame == "world" and found.videos[0].camera.width == 16


@pytest.mark.parametrize(
    "change, says",
    [
        ({"fps": True}, "videos[0].fps (of 'left'): expected a number or null; found true. "),
        ({"fps": " 3_0 "}, "videos[0].fps (of 'left'): expected a number or null; found ' 3_0 '. "),
        ({"fps": 10**4000}, "videos[0].fps (of 'left'): expected a number below 1e308; found a whole number of some 4"),
        ({"name": None}, "videos[0].name: expected text; found null. "),
        ({"name": 7}, "videos[0].name: expected text; found 7. "),
        ({"name": ""}, "videos[0].name (of ''): expected text of length >= 1; found ''. "),
        (
            {"name": "a\x1b[2J"},
            r"videos[0].name: expected text on one line, without control characters; found 'a\x1b[2J'",
        ),
        (
            {"name": "a\u202eb"},
            r"videos[0].name: expected text on one line, without control characters; found 'a\u202eb'",
        ),
        (
            {"name": "a\ud800"},
            r"videos[0].name: expected text on one line, without control characters; found 'a\ud800'",
        ),
        ({"frames": ["a.png", 3]}, "videos[0].frames[1] (of 'left'): expected text; found 3. "),
        ({"fsp": 30}, "videos[0].fsp (of 'left'): expected a field that there is; found 'fsp'. Did you mean 'fps'? "),
        ({"zebra": 1}, "videos[0].zebra (of 'left'): expected one of the fields name, file, frames, "),
        (
            {"camera": CAMERA | {"width": 160.9}},
            "videos[0].camera.width (of 'left'): expected a whole number or null; ",
        ),
        ({"camera": CAMERA | {"W2C": 1}}, "videos[0].camera.W2C (of 'left'): expected a field that there is; found "),
        ({"camera": CAMERA | {"K": [[1, 2]]}}, "videos[0].camera.K (of 'left'): expected a list of length >= 3; "),
        (
            {"depth": {"scales": 1}},
            "videos[0].depth.scales (of 'left'): expected a field that there is; found 'scales'. Did",
        ),
        ({"camera": 5}, "videos[0].camera (of 'left'): expected an object or null; found 5. "),
        ({"range": [0, -3]}, "videos[0].range[1] (of 'left'): expected a whole number >= 0; found -3. "),
    ],
)
def test_each_slip_is_named_with_what_was_expected_and_found(change, says):
    assert says in refused(scene(**change))


@pytest.mark.parametrize(
    "change, says",
    [
        ({"notes": 5}, "notes: expected a list; found 5. "),
        ({"version": 2}, "version: expected 1; found 2. "),
        ({"notes": ["a\nb"]}, r"notes[0]: expected text on one line, without control characters; found 'a\nb'"),
        ({"frame": None}, "frame: expected text; found null. "),
        ({"videos": {}}, "videos: expected a list; found an object with no fields. "),
        ({"videos": []}, "videos: expected a list of length >= 1; found []. "),
        ({"videos": [3]}, "videos[0]: expected an object; found 3. "),
        ({"vidoes": []}, "vidoes: expected a field that there is; found 'vidoes'. Did you mean 'videos'? "),
        ({"a\x07b": 1}, r"a key: expected text on one line, without control characters; found 'a\x07b'. "),
    ],
)
def test_slips_of_the_whole(change, says):
    assert says in refused(scene() | change)


def test_a_field_that_is_missing_is_named():
    document = scene()
    del document["videos"]
    assert "scene.json: videos: expected a value; found none. Add it" in refused(document)
    assert "scene.json: the whole of it: expected an object; found a list of 0" in refused([]).replace(
        "[]", "a list of 0"
    )


@pytest.mark.parametrize(
    "text, says",
    [
        ('{"fps": ' + "9" * 5000 + "}", "4300 digits"),
        ('{"fps": 30, "fps": 25}', "the key 'fps' occurs twice"),
        ("[" * 100_000, "expected JSON"),
        ('{"a": "\xff"}', "expected JSON"),
    ],
    ids=["digits", "twice", "deep", "bytes"],
)
def test_json_that_cannot_be_read_names_the_file(tmp_path, text, says):
    (tmp_path / "x.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=rf"x\.json: expected JSON; .*{says if says != 'expected JSON' else ''}"):
        read_json(tmp_path / "x.json")


def test_what_is_found_is_shown_in_one_short_line():
    for value in ("a" * 10_000, "\x1b[0m", 10**5000, [[1] * 9] * 9, {"a": {}}, [1.5] * 100, None, True, -2.5):
        assert shown(value).isprintable() and len(shown(value)) <= 80


def test_offsets_with_a_misspelt_key_are_refused(tmp_path):
    offsets = Offsets.known(["a", "b"], np.array([0.0, 0.5]), fps=30)
    document = offsets.to_dict() | {"refrence": "a"}
    (tmp_path / "o.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"o\.json: refrence: .* Did you mean 'reference'\?"):
        Offsets.load(tmp_path / "o.json")
    document = offsets.to_dict()
    del document["videos"][1]["fps"]
    (tmp_path / "o.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"o\.json: videos\[1\]\.fps .*expected a value; found none"):
        Offsets.load(tmp_path / "o.json")


def test_the_schemas_of_the_docs_are_up_to_date(tmp_path):
    """Written by another process, whose exit code tells whether it ended well."""
    subprocess.run([sys.executable, "-m", "otsync.io.schemas", str(tmp_path)], cwd=ROOT, check=True)
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.schema.json" for name in SCHEMAS}
    for path in tmp_path.iterdir():
        assert path.read_text() == (ROOT / "docs/schemas" / path.name).read_text(), "run: make schemas"


def test_the_schema_of_a_scene_is_that_of_its_reader():
    schema = json.loads((ROOT / "docs/schemas/scene.schema.json").read_text())
    assert set(schema["$defs"]["SceneFile"]["properties"]) == set(fields_of(SceneFile))
    assert not schema["$defs"]["VideoFile"]["additionalProperties"]
