"""``otsync bench films``: what is told of the routes is what they answered."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from otsync.types import Offsets, Status
from recon.bench import films


def row(error, sigma, trusted=True):
    return {"route": "depth", "error": error, "sigma": sigma, "trusted": trusted}


def test_a_route_is_summed_up_over_what_it_answered():
    rows = [row(0.1, 0.2), row(0.3, 0.2), row(1.5, 0.2), row(2.0, 3.0, False), row(None, None, False)]
    told = films.summary("depth", rows)
    assert (told["videos"], told["answers"], told["trusted"], told["wrong"], told["over a frame"]) == (5, 4, 3, 1, 2)
    assert told["1 sigma"] == pytest.approx(0.5) and told["2 sigma"] == pytest.approx(0.75)
    assert films.summary("stereo", [])["1 sigma"] is None


def test_answers_are_held_against_the_truth(tmp_path, monkeypatch):
    """The routes are replaced: what they say of a filmed scene is known."""
    asked = []

    def answered(scene, route, cache, map):
        asked.append(route)
        if route == "stereo":
            return None
        truth = Offsets.load(tmp_path / "3-12-2" / "recording" / "truth.json")
        found = Offsets.known(scene.names, truth.seconds + np.array([0, 0.5 / 30]), 30.0)
        return replace(found, sigma=np.array([0, 0.01]), flags=((), (Status.COARSE,)))

    monkeypatch.setattr(films, "synchronized", answered)
    monkeypatch.setattr(
        films, "fitted", lambda scene, start, *_: replace(start, sigma=np.array([0, 0.02]), flags=((),) * 2)
    )
    rows = list(films.answers(tmp_path, 3, (12, 2), ("depth", "stereo", "fit"), map))
    assert [r["error"] for r in rows] == [pytest.approx(0.5), None, pytest.approx(0.5)]
    assert [r["sigma"] for r in rows] == [pytest.approx(0.3), None, pytest.approx(0.6)]
    assert [r["flags"] for r in rows] == ["coarse", "refused", ""]
    assert [r["trusted"] for r in rows] == [False, False, True]
    assert asked == ["depth", "stereo"]  # the fit begins from the answer with depth that is there already


def test_a_video_that_an_answer_leaves_out_is_refused():
    names = ("a", "b", "c")
    truth = Offsets.known(names, np.array([0, 1, 2]) / 30, 30.0)
    found = replace(Offsets.known(("a", "c"), np.array([0, 2.5]) / 30, 30.0), sigma=np.array([0, 0.01]))
    b, c = films.told("fit", 3, names, found, truth)
    assert b["error"] is None and b["trusted"] is False and b["flags"] == "refused"
    assert c["error"] == pytest.approx(0.5) and c["sigma"] == pytest.approx(0.3) and c["trusted"]


def test_a_route_that_there_is_not_is_refused(tmp_path):
    with pytest.raises(ValueError, match="--only: expected routes among depth, pixels, stereo, fit; found deep"):
        films.run(tmp_path, only=("deep",))


@pytest.mark.slow
def test_one_film_through_all_routes(tmp_path):
    assert films.run(tmp_path, seeds=1, first_seed=7) == 0
    told = {r["route"]: r for r in json.loads((tmp_path / "films_routes.json").read_text())["rows"]}
    assert set(told) == {"depth", "pixels", "stereo", "fit"} and told["fit"]["median error"] < 0.3
