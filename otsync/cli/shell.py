"""What the commands ``otsync`` and ``recon`` share: options into an object that runs, errors into exit codes."""

from __future__ import annotations

import _thread
import errno
import importlib
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, TextIO

import tyro

from .. import __version__, plugins, progress

EXTRAS = {
    "torch": "recon",
    "plyfile": "recon",
    "av": "video",
    "cv2": "video",
    "PIL": "video",
    "pycolmap": "calibrate",
    "poselib": "calibrate",
    "gsplat": "cuda",
    "viser": "view",
    "fourdgs": "4dgs",
    "transformers": "learned",
    "torchvision": "learned",
    "onnxruntime": "learned",
    "onnx": "learned",
    "ott": "rivals",
    "jax": "rivals",
}
"""The extra of otsync (pyproject.toml) that brings a package, by the name that it is imported by."""

SHARED = """
Options of every command: --plugin FILE.py loads your own matchers, readers, losses, ... (also: OTSYNC_PLUGINS);
-v tells more, --quiet tells nothing but results and errors; --version. Shell completion:
--tyro-print-completion bash|zsh|tcsh.
"""

Load = Callable[[], Callable[..., Any]]
"""Gives a command's dataclass when it is asked for."""


def from_places(places: Mapping[str, str]) -> dict[str, Load]:
    """What loads each of some commands, from where it is ("module:Name"): one runs without loading the others."""

    def load(place: str) -> Callable[..., Any]:
        module, _, name = place.partition(":")
        return getattr(importlib.import_module(module), name)

    return {name: partial(load, place) for name, place in places.items()}


def missing_package(error: ModuleNotFoundError) -> str:
    """Which package is not there, and what to install."""
    if remedy := getattr(error, "remedy", ""):
        return f"needs {error.name}. {remedy}"
    if not error.name:
        return f"needs a package that is not installed: {error}"
    package = error.name.partition(".")[0]
    extra = EXTRAS.get(package)
    what = "otsync" if extra is None else f"'otsync[{extra}]'"
    return f"needs {error.name}. Install it: pip install {what}."


def run_command(
    prog: str,
    commands: Callable[[], Mapping[str, Load]],
    args: Sequence[str] | None,
    *,
    description: str,
    refused: tuple[type[Exception], ...],
    interrupted: str,
) -> int:
    """Run the subcommand that ``args`` (default: the process's) name; the exit code.

    Args:
        commands: gives what loads each command, by name: a dataclass with a ``run`` method that returns the exit code.
            Asked after plugins are loaded; only the command that runs is loaded, so that its rivals cost no start-up
            time.
        refused: errors that mean an answer is not to be trusted: exit code 1. Bad arguments or files (ValueError,
            OSError, a package that is not installed) give 2, an interrupt 130.
        interrupted: what an interrupted run leaves behind, in words.

    SIGTERM is an interrupt like Ctrl-C, and so is what a library makes of one that it was not made for: another error.
    Where nobody reads standard output any more (``otsync ... | head``), the
    command ends without a word, with the exit code of programs that SIGPIPE ends.
    """
    told = Interrupted()
    try:
        try:
            rest = shared_options(list(sys.argv[1:] if args is None else args))
            if rest is None:
                print(f"{prog} {__version__}")
                return 0
            command = parsed(prog, commands(), rest, description + SHARED)
            with ended_like_ctrl_c(told):
                return command.run()
        finally:
            sys.stdout.flush()  # not later, when the interpreter ends and can only complain
    except BrokenPipeError as error:  # perhaps of another program that we write to
        if nobody_reads(sys.stdout):
            leave(sys.stdout)
            return NOBODY_READS
        code, said = 2, of_the_system(error)
    except refused as error:
        code, said = 1, str(error)
    except ModuleNotFoundError as error:
        code, said = 2, missing_package(error)
    except ValueError as error:
        code, said = 2, str(error)
    except OSError as error:
        code, said = 2, of_the_system(error)
    except MemoryError as error:
        code, said = 2, str(error) or "not enough memory"
        if "Use " not in said:  # our own name a file and what to do
            said += ". Use fewer frames or videos, or smaller images."
    except KeyboardInterrupt:
        told.came = True
    except Exception:
        if not told.came:
            raise
    if told.came:
        code, said = 130, f"interrupted; {interrupted}"
    print(f"{prog}: {said}", file=sys.stderr)
    return code


NOBODY_READS = 128 + 13
"""Exit code of a program that SIGPIPE ended, as shells tell it."""


def nobody_reads(stream: TextIO) -> bool:
    """Whether a stream is a pipe whose other end is closed."""
    try:
        look = select.poll()
        look.register(stream.fileno(), 0)
    except (AttributeError, OSError, ValueError):  # no poll on this system; a stream that is no file
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in look.poll(0))


def leave(stream: TextIO) -> None:
    """What is still to be written to a stream goes nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


REMEDIES = {
    errno.ENOSPC: "Free some space, or write to another disk.",
    errno.EDQUOT: "Free some space, or write to another disk.",
    errno.EFBIG: "Write to a disk that takes larger files.",
    errno.EACCES: "Check its permissions.",
    errno.EPERM: "Check its permissions.",
    errno.EROFS: "Write to another disk.",
    errno.EMFILE: "Raise the limit of open files (ulimit -n).",
    errno.ENAMETOOLONG: "Give it a shorter name.",
    errno.EIO: "Check the disk.",
}
"""What to do about an error of the system, by its number."""


def of_the_system(error: OSError) -> str:
    """The file, what went wrong and what to do, of an error that the system raised; of our own their words."""
    if error.errno is None or not error.strerror:
        return str(error)
    what = f"{error.filename}: " if error.filename is not None else ""
    return f"{what}{error.strerror}. {REMEDIES.get(error.errno, 'Check the path and the disk.')}"


class Interrupted:
    """Whether a signal came that ends a command, and whether the command still runs."""

    came = False
    runs = False


@contextmanager
def ended_like_ctrl_c(told: Interrupted) -> Iterator[None]:
    """Ctrl-C, and SIGTERM, which schedulers and service managers send, raise KeyboardInterrupt, so that everything is
    cleared up; ``told`` remembers it. One that comes where no error can be raised (a library's callback) would be told
    on standard error and forgotten: it comes again. Where clearing up takes long, standard error says why.

    Only a process's main thread can be told so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        first, told.came = not told.came, True
        if first:
            with suppress(RuntimeError, MemoryError):  # no more threads: then without a word
                # threading.Thread takes locks, which this thread may hold
                _thread.start_new_thread(patience, ())
        raise KeyboardInterrupt

    def patience() -> None:
        time.sleep(PATIENCE)
        if told.runs and sys.stderr is not None:
            with suppress(OSError, ValueError):  # nobody reads it any more
                print(f"\n{WAITS}", file=sys.stderr, flush=True)

    def swallowed(error: Any) -> None:
        if issubclass(error.exc_type, KeyboardInterrupt):
            _thread.start_new_thread(once_more, ())
        else:
            hook(error)

    def once_more() -> None:  # from another thread: here the error would be swallowed again
        time.sleep(SWALLOWED)
        if not told.runs:  # it has ended, and what holds the process now would be killed
            return
        if hasattr(signal, "pthread_kill"):  # wakes the main thread where it sleeps or waits
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
        else:
            _thread.interrupt_main(signal.SIGTERM)

    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    before = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        # an interrupt that somebody handles on his own, or ignores (nohup), is his
        if number == signal.SIGTERM or signal.getsignal(number) is signal.default_int_handler:
            before[number] = signal.signal(number, interrupt)
    told.runs = True
    try:
        yield
    finally:
        told.runs = False
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


SWALLOWED = 0.05
"""Seconds until an interrupt that was swallowed comes again."""

PATIENCE = 1.5
"""Seconds after an interrupt that a command may take to end without a word."""

WAITS = "interrupted: waits for what is under way ..."


def parsed(prog: str, commands: Mapping[str, Load], args: list[str], description: str) -> Any:
    """The command that the arguments name, with its options set; help and mistakes end the process as usual."""
    chosen = args[0] if args else ""
    if chosen in commands:  # the others stay unloaded
        return tyro.cli(commands[chosen](), prog=f"{prog} {chosen}", args=args[1:])
    return tyro.extras.subcommand_cli_from_dict(
        {name: _listed(name, load) for name, load in commands.items()},
        prog=prog,
        description=description,
        args=args,
        config=(tyro.conf.AvoidSubcommands,) if not args else (),
    )


def _listed(name: str, load: Load) -> Callable[..., Any]:
    """A command for the list of all; one whose packages are not installed says what to install."""
    try:
        return load()
    except ModuleNotFoundError as error:
        return type(name, (), {"__doc__": f"Not installed: {missing_package(error)}"})


def shared_options(args: list[str]) -> list[str] | None:
    """Heed the options that every command takes, and give back the rest; None when the version is asked for.

    They may stand anywhere before a ``--``. ValueError for both of --verbose and --quiet, and for plugins that do not
    load.
    """
    if args == ["--version"]:
        return None
    rest: list[str] = []
    files: list[str] = []
    wanted = {"-v": False, "--quiet": False}
    while args:
        arg = args.pop(0)
        if arg in ("-v", "--verbose"):
            wanted["-v"] = True
        elif arg in ("-q", "--quiet"):
            wanted["--quiet"] = True
        elif arg == "--plugin" or arg.startswith("--plugin="):
            value = arg.partition("=")[2] or (args.pop(0) if args else "")
            if not value:
                raise ValueError("--plugin: expected a Python file; found nothing.")
            files.append(value)
        elif arg == "--":
            rest += [arg, *args]
            break
        else:
            rest.append(arg)
    if all(wanted.values()):
        raise ValueError("-v, --quiet: expected one of them; found both.")
    progress.be_quiet(wanted["--quiet"])
    if wanted["-v"]:
        logging.basicConfig(stream=sys.stderr, format="%(name)s: %(message)s")
    for name in ("otsync", "recon"):
        level = logging.DEBUG if wanted["-v"] else logging.ERROR if wanted["--quiet"] else logging.NOTSET
        logging.getLogger(name).setLevel(level)
    plugins.load_files(files)
    return rest
