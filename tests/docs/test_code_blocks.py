"""Code in README and docs runs: Python blocks page by page, shell lines as marked; every command line is parsed."""

from __future__ import annotations

import importlib.util
import io
import shlex
import sys
import types
from contextlib import redirect_stderr, redirect_stdout
from glob import glob
from pathlib import Path

import pytest

from otsync import cli, plugins, progress
from otsync.cli.commands import commands as otsync_commands
from otsync.cli.shell import parsed, shared_options
from recon import cli as recon_cli
from recon.cli.commands import commands as recon_commands
from tests.docs.pages import PAGES, Block, blocks, command_lines, name_of

WITH_CODE = [page for page in PAGES if any(b.language in ("python", "sh") for b in blocks(page.read_text()))]
COMMANDS = {"otsync": otsync_commands, "recon": recon_commands}
MAIN = {"otsync": cli.main, "recon": recon_cli.main}


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """An empty folder; what a page registers and imports there is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    pages = {"page", *(path.stem for path in tmp_path.glob("*.py"))}
    for group in plugins.GROUPS:
        plugins.forget(*(thing for thing in plugins.registered(group).values() if thing.__module__ in pages))
    for name in pages:
        sys.modules.pop(name, None)
    progress.be_quiet(False)


def run_line(line: str, flagged: bool = False) -> None:
    """Run a command line as a shell would, in this process: importing everything again would take most of the time."""
    prog, *words = shlex.split(line)
    args = [name for word in words for name in (sorted(glob(word)) if "*" in word else [word])]
    out = io.StringIO()
    try:
        with redirect_stderr(out), redirect_stdout(out):
            code = MAIN[prog](args)
    except SystemExit as end:  # of --help
        code = end.code
    assert code == 1 if flagged else not code, f"{line}\n{out.getvalue()[-3000:]}"


def lacks(block: Block) -> str:
    """A package that the block needs and that is not installed."""
    kind, _, package = block.comment.partition(":")
    package = package.strip()
    needed = kind in ("needs", "run") and package
    return package if needed and importlib.util.find_spec(package) is None else ""


LONG = {"own-frames.md"}
"""Pages whose code takes half a minute; an example runs the same every time."""


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=[pytest.mark.slow] if p.name in LONG else []) for p in WITH_CODE],
    ids=[name_of(p) for p in WITH_CODE],
)
def test_the_code_of_a_page_runs_in_order(page, elsewhere):
    module = types.ModuleType("page")
    sys.modules["page"] = module
    for block in blocks(page.read_text()):
        if lacks(block):
            pytest.skip(f"{lacks(block)} is not installed")
        if block.language == "python" and block.title:
            Path(block.title).write_text(block.text)
        elif block.language == "python" and not block.skipped:
            code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
            with redirect_stdout(io.StringIO()):
                exec(code, module.__dict__)
        elif block.language == "sh" and block.runs:
            for line in command_lines(block):
                run_line(line, block.flagged)


LINES = [
    pytest.param(line, id=f"{name_of(page)}: {line[:60]}")
    for page in PAGES
    for block in blocks(page.read_text())
    if block.language == "sh"
    for line in command_lines(block)
    if "--plugin" not in line  # run, see below: they need a file of the page
]


def parse(line: str) -> None:
    """Let the command's own parser read the line, with everything that it would refuse before the work."""
    prog, *args = shlex.split(line.replace("--device cuda", "--device cpu"))  # refused where there is none
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint), redirect_stdout(io.StringIO()):
            command = parsed(prog, COMMANDS[prog](), shared_options(args) or [], "")
    except SystemExit as end:
        assert not end.code, f"{line}\n{complaint.getvalue()}"
        return
    taken = [str(path) for path in getattr(command, "tracks", ()) if ":" in str(path)]
    assert not taken, f"{line}\nno algorithm, so it was taken for a file: {taken}"


@pytest.mark.parametrize("line", LINES)
def test_every_command_line_parses(line):
    parse(line)


def test_a_wrong_command_line_does_not_parse():
    parse("otsync sync a.npz b.npz --out x matcher:partial-fgw --matcher.mass 0.65")
    for wrong in (
        "otsync sink a.npz",
        "otsync sync recording/ --recordings.route tracks",
        "otsync sync recording/ --recording.route stereos",
        "otsync sync a.npz b.npz matcher:mine",
    ):
        with pytest.raises(AssertionError):
            parse(wrong)


def test_lines_with_plugins_are_run():
    shell = [(page, block) for page in PAGES for block in blocks(page.read_text()) if block.language == "sh"]
    with_plugins = [(p, block) for p, block in shell if any("--plugin" in line for line in command_lines(block))]
    assert with_plugins
    assert not [f"{name_of(p)}, line {block.line}" for p, block in with_plugins if not block.runs]
