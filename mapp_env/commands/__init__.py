"""The commands of ``python -m mapp_env``, also installed as ``mapp``, one file each.

A command's file has ``add_arguments(parser)``, ``run(arguments)`` and a docstring, which
``--help`` shows. What cannot be done is a ``ValueError`` or an ``ImportError`` anywhere below:
:func:`main` makes a line of it.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from mapp_env import __version__
from mapp_env.commands import evaluate, info, render, solve, universe
from mapp_env.commands.reports import OutputError

__all__ = ["COMMANDS", "main"]

COMMANDS: tuple[ModuleType, ...] = (solve, render, evaluate, universe, info)
PROGRAM = "mapp"  # of the console script
REFUSED = 2  # exit status of what cannot be done, as of argparse
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """A parser whose refusals are one line, as all others are."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        self.exit(REFUSED, f"error: {_one_line(message)} (see {self.prog} --help)\n")


def main(command_line: Sequence[str] | None = None) -> int:
    """Carry out a command line, by default that of this process, and return its exit status.

    It is 0, 2 with a line on the standard error stream that says what is wrong, or 130 where the
    user interrupts.
    """
    parser = _Parser(
        prog=PROGRAM if os.path.basename(sys.argv[0]) == PROGRAM else "python -m mapp_env",
        description="Multi-agent path planning on walled grids, from the command line.",
    )
    parser.add_argument("--version", action="version", version=f"mapp_env {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        text = (command.__doc__ or "").strip()
        sub = commands.add_parser(
            command.__name__.rpartition(".")[2],
            help=text.partition("\n")[0].rstrip("."),
            description=text,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        command.add_arguments(sub)
        sub.set_defaults(run=command.run)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may hold any letter
    arguments = parser.parse_args(command_line)
    try:
        arguments.run(arguments)
    except BrokenPipeError:
        _drop_output()  # nobody reads on
    except (ValueError, ImportError) as error:
        return _refuse(_name_option(str(error), arguments))
    except OutputError as error:
        _drop_output()
        return _refuse(str(error))
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


def _refuse(message: str) -> int:
    if sys.stderr is not None:  # else it would go to the standard output
        print(f"error: {_one_line(message)}", file=sys.stderr)
    return REFUSED


def _name_option(message: str, arguments: argparse.Namespace) -> str:
    """Return a message of the package, "n_agents must be ...", for the option."""
    found = re.match(r"\w+(?= must | cannot )", message)
    if found is None or found[0] not in arguments:
        return message
    return f"--{found[0].replace('_', '-')}{message[found.end() :]}"


def _drop_output() -> None:
    """Let nothing more go to the standard output: Python would complain when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _one_line(message: str) -> str:
    return " ".join(message.split())
