"""The commands of ``python -m mapp_env``, also installed as ``mapp``, one file each.

A command's file has ``add_arguments(parser)``, ``run(arguments)`` and a docstring, which
``--help`` shows. What cannot be done is a ``ValueError`` or an ``ImportError`` anywhere below:
:func:`main` makes a line of it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from mapp_env.commands import info, render, solve, universe

__all__ = ["COMMANDS", "main"]

COMMANDS: tuple[ModuleType, ...] = (solve, render, universe, info)
PROGRAM = "mapp"  # of the console script
REFUSED = 2  # exit status of what cannot be done, as of argparse
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """A parser whose refusals are one line, as all others are."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        self.exit(REFUSED, f"error: {_one_line(message)} (see {self.prog} --help)\n")


def main(command_line: Sequence[str] | None = None) -> int:
    """Carry out a command line.

    Parameters
    ----------
    command_line : sequence of str, optional
        What follows ``python -m mapp_env``; by default that of this process.

    Returns
    -------
    int
        0, or 2 with a line on the standard error stream that says what is wrong.
    """
    parser = _Parser(
        prog=PROGRAM if os.path.basename(sys.argv[0]) == PROGRAM else "python -m mapp_env",
        description="Multi-agent path planning on walled grids, from the command line.",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        text = (command.__doc__ or "").strip()
        sub = commands.add_parser(
            command.__name__.rpartition(".")[2],
            help=text.splitlines()[0].rstrip("."),
            description=text,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        command.add_arguments(sub)
        sub.set_defaults(run=command.run)
    arguments = parser.parse_args(command_line)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Nobody reads on; and Python should not complain of it when it flushes at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, ImportError) as error:
        print(f"error: {_one_line(str(error))}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


def _one_line(message: str) -> str:
    return " ".join(message.split())
