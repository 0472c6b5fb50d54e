"""What an installed package must bring along, and what its citation file must say."""

from __future__ import annotations

import re
import tomllib

import pytest

import otsync
from tests.docs.pages import ROOT


def test_a_wheel_holds_types_marks_and_baselines(tmp_path, monkeypatch):
    pytest.importorskip("setuptools")
    from setuptools import Distribution

    monkeypatch.chdir(ROOT)
    distribution = Distribution({"script_name": "setup.py"})
    distribution.parse_config_files()
    build = distribution.get_command_obj("build_py")
    build.build_lib = str(tmp_path)
    build.ensure_finalized()
    held = {path.removeprefix(f"{tmp_path}/") for path in build.get_outputs(include_bytecode=False)}
    code = {path.relative_to(ROOT).as_posix() for name in ("otsync", "recon") for path in (ROOT / name).rglob("*.py")}
    data = {path.relative_to(ROOT).as_posix() for path in (ROOT / "otsync/bench/baselines").glob("*.json")}
    assert len(data) >= 4
    data |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "recon/result/web").iterdir()}
    assert held == code | data | {"otsync/py.typed", "recon/py.typed"}


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert project["version"] == otsync.__version__
    assert re.search(r"^version: (.+)$", citation, re.MULTILINE)[1] == otsync.__version__
    assert f"## [{otsync.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_every_package_of_the_extras_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.partition("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines()}
    extras = {name: wanted for name, wanted in project["optional-dependencies"].items() if name != "rivals"}
    wanted = [*project["dependencies"], *(each for group in extras.values() for each in group)]
    names = {re.match(r"[\w-]+", each)[0].lower() for each in wanted} - {"otsync"}
    assert not names - pinned
