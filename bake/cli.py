"""The command line. Subcommands are imported when they are called: `solidgrain --help` needs neither torch nor VTK.

Exit codes: 0 done, 1 failed, 2 usage, 3 verification failed, 130 interrupted. stdout carries data only; progress, logs and
errors go to stderr, an error as one line.
"""

from __future__ import annotations

import argparse
import codecs
import importlib
import io
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from types import FrameType, ModuleType
from typing import NoReturn

from solidgrain.bake.interrupts import on_stop
from solidgrain.bake.messages import tell, tell_error

COMMANDS = {
    "bake": ("solidgrain.bake.commands.bake", "evaluate a texture on a voxel grid and write it to files"),
    "merge": ("solidgrain.bake.commands.merge", "complete the files of a plan whose shards have all been baked"),
    "verify": ("solidgrain.bake.commands.verify", "check baked files: checksums, and random voxels evaluated again"),
    "view": ("solidgrain.bake.commands.view", "look at a volume with pyvista, on screen or to a PNG"),
    "info": ("solidgrain.bake.commands.info", "say what a texture or bundle is, and check it"),
    "doctor": ("solidgrain.bake.commands.doctor", "say what this installation can do, and what is wrong with it"),
    "encode": ("solidgrain.bake.commands.encode", "turn a photograph into a texture of a space"),
    "blend": ("solidgrain.bake.commands.blend", "make textures between two of a space, or one that goes from one to the other"),
    "adapt": ("solidgrain.train.adapt_command", "fit a texture of a space to a photograph that it was not trained on"),
    "train": ("solidgrain.train.command", "learn a solid texture from one photograph"),
    "export": ("solidgrain.export.command", "turn a training run into a bundle of ONNX graphs"),
    "evaluate": ("solidgrain.export.evaluate_command", "measure a texture's slices against its exemplar"),
}
EXTRAS = {
    "torch": "train",
    "onnx": "export",
    "spox": "export",
    "OpenEXR": "bake",
    "OpenImageIO": "bake",
    "isal": "bake",
    "jsonschema": "bake",
    "distributed": "dask",
    "stlpips_pytorch": "evaluate",
    "etcpak": "dds",
    "pyvista": "view",
    "vtkmodules": "view",
}
WITH_AN_EXTRA = ("train", "export", "evaluate")  # of their name, and it brings all that they need
DONE, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line instead of a page of usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line. Returns the exit code."""
    arguments = _glue_negative(list(sys.argv[1:] if argv is None else argv))
    if isinstance(sys.stdout, io.TextIOWrapper):
        codecs.register_error("as it came", _as_it_came)
        sys.stdout.reconfigure(errors="as it came")
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        resumes = arguments[:1] == ["merge"] or any(word.startswith(("--resume", "--shard", "--dask")) for word in arguments)
        left = "go on with the same flags" if resumes else "nothing half-written was left behind"
        tell(f"interrupted; {left}")
        return INTERRUPTED


def _run(arguments: list[str]) -> int:
    """The command, and one line for each kind of error."""
    with suppress(ValueError):  # in another thread than the one that signals interrupt
        on_stop(_interrupt)  # clean up as for Ctrl-C
    try:
        parser, module = _parser(arguments)
    except ModuleNotFoundError as error:
        return _missing(error, _called(arguments))
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        program = f"solidgrain {options.command}" if options.command else "solidgrain"
        Parser(prog=program).error(f"unrecognized arguments: {' '.join(unknown)}")
    if module is None:
        parser.print_help()
        return USAGE
    from solidgrain.runtime.errors import SolidgrainError, UsageError  # here: they import numpy, which --help can do without

    try:
        code = int(module.run(options))
        sys.stdout.flush()
        return code
    except UsageError as error:
        _fail(str(error))
        return USAGE
    except SolidgrainError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        return _missing(error, options.command)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and error.filename is None:  # os.getcwd
            return _fail("the working folder is no longer there; change to another one")
        if error.filename is None:  # stdout: a closed pipe, a full device
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains once more on exit
            return _fail(f"cannot print the result ({error.strerror})")
        return _fail(f"{error.filename}: {error.strerror}")


def _parser(arguments: Sequence[str]) -> tuple[Parser, ModuleType | None]:
    """The parser, with the arguments of the one command that is called, and that command's module."""
    parser = Parser(prog="solidgrain", description="Solid textures from one photograph: train, export, bake, view.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    called = _called(arguments)
    module = None
    for name, (module_name, summary) in COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
        if name == called:
            module = importlib.import_module(module_name)
            module.add_arguments(command)
    return parser, module


def _as_it_came(error: UnicodeError) -> tuple[bytes, int]:
    """Bytes of file names that are no text leave as they came; what the terminal's encoding lacks is escaped."""
    assert isinstance(error, UnicodeEncodeError)
    try:
        return error.object[error.start : error.end].encode("ascii", "surrogateescape"), error.end
    except UnicodeEncodeError:
        return error.object[error.start : error.end].encode("ascii", "backslashreplace"), error.end


def _called(arguments: Sequence[str]) -> str | None:
    """The command that is called."""
    return next((word for word in arguments if not word.startswith("-")), None)


def _glue_negative(arguments: list[str]) -> list[str]:
    """`--origin -1,0,0` as `--origin=-1,0,0`: argparse would take the value for a flag."""
    glued: list[str] = []
    for word in arguments:
        if re.match(r"-[\d.]", word) and glued and re.fullmatch(r"--[a-z-]+", glued[-1]):
            glued[-1] += f"={word}"
        else:
            glued.append(word)
    return glued


def _missing(error: ModuleNotFoundError, command: str | None) -> int:
    """Name the extra that brings a package. What no extra brings is raised again."""
    package = (error.name or "").split(".")[0]
    if package not in EXTRAS:
        raise error
    extra = command if command in WITH_AN_EXTRA else EXTRAS[package]
    return _fail(f"{command} needs the package {package}; pip install 'solidgrain[{extra}]'")


def _fail(message: str) -> int:
    tell_error(message)
    return FAILED


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
