"""The command ``fide``: one module ``NAME_command`` for each command.

Exit codes: 0 done; 1 a run failed, or its output could not be written; 2 wrong usage, with one line
on standard error; 130 and 143 stopped by Ctrl-C and SIGTERM, with everything saved.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NoReturn

from fide_plugins import __version__
from fide_plugins.cli.terminal import complain, discard
from fide_plugins.errors import DependencyError
from fide_plugins.runtime import laboratory

__all__ = ["commands", "main", "module_of"]

COMMANDS = {
    "fit": "fit a picture of your own, with your renderer or a model",
    "learn": "learn a renderer once, for every later picture",
}
"""Commands of this package."""
_OTHERS = ("fide_lab.cli", "fide_adapters")
"""Packages with more, in modules NAME_command, and with a table COMMANDS of them."""


def _tables() -> dict[str, dict[str, str]]:
    """Commands of each package that is installed."""
    others = [name for name in _OTHERS if find_spec(name.split(".")[0])]
    return {__name__: COMMANDS, **{name: import_module(name).COMMANDS for name in others}}


def commands() -> dict[str, str]:
    """What each command is for."""
    return {name: text for table in _tables().values() for name, text in table.items()}


def module_of(command: str) -> Any:
    """Module of a command; DependencyError for one that no installed package has."""
    for package, table in _tables().items():
        if command in table:
            return import_module(f"{package}.{command}_command")
    return laboratory.module(f"cli.{command}_command")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (default: the process's own) and return its exit code."""
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w") as nowhere:  # for streams that are closed
        sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere
        try:
            code = _main(sys.argv[1:] if argv is None else list(argv))
            sys.stdout.flush()
            return code
        except BrokenPipeError:  # such as: fide list tasks | head -1
            discard(sys.stdout)
            return 0
        except OSError as error:  # such as: fide list tasks > /dev/full
            discard(sys.stdout)
            place = error.filename or "standard output"
            complain("fide", f"cannot write to {place}: {error.strerror or error}")
            return 1
        finally:
            sys.stdout, sys.stderr = before


def _main(argv: list[str]) -> int:
    parser = _parser()
    try:
        if not argv:
            parser.print_help(sys.stderr)
            return 2
        # Two steps, so that only the module of the given command is imported.
        name = parser.parse_args(argv[:1]).command
        try:
            module = module_of(name)
        except DependencyError as error:
            return complain("fide", f"{name!r} is no command of fide_plugins, and {error}")
        own = _Parser(f"fide {name}", module.__doc__ or "")
        module.add_arguments(own)
        code: int = module.execute(own.parse_args(argv[1:]), ["fide", *argv])
        return code
    except _Usage as usage:
        return complain(usage.prog, f"{usage}; see {usage.prog} --help")
    except _Done as done:
        return int(done.args[0])
    except MemoryError as error:
        return complain(
            "fide", f"there is not enough memory ({error}); use smaller images or fewer parameters"
        )
    except KeyboardInterrupt:
        complain("fide", "stopped")
        return 130


class _Usage(Exception):
    def __init__(self, prog: str, message: str) -> None:
        super().__init__(message)
        self.prog = prog


class _Done(Exception):
    """Argparse has printed the help or the version."""


class _Parser(argparse.ArgumentParser):
    """Parser that raises exceptions instead of ending the process."""

    def __init__(self, prog: str, description: str, usage: str | None = None) -> None:
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(prog, usage, description, formatter_class=form, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise _Usage(self.prog, message)

    def _print_message(self, message: str, file: Any = None) -> None:
        (file or sys.stderr).write(message)  # whose errors argparse would ignore

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        raise _Done(status)


def _parser() -> _Parser:
    known, with_lab = commands(), laboratory.is_installed()
    width = max(map(len, known))
    listing = "\n".join(f"  fide {name:{width}}   {text}" for name, text in known.items())
    description = (
        f"Fit a black-box renderer to a picture.\n\n{listing}\n\nSee fide COMMAND --help for each."
        + " A good start: fide run voronoi --size 112" * with_lab
    )
    parser = _Parser("fide", description, "fide COMMAND ...")
    parser.add_argument("--version", action="version", version=f"fide {__version__}")
    parser.add_argument("command", choices=known if with_lab else None,
                        metavar="COMMAND", help=argparse.SUPPRESS)  # fmt: skip
    return parser
