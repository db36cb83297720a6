"""What the command lines have in common, and commands that a person can paste."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import sys
from pathlib import Path

SUCCEEDED, FAILED, BAD_INPUT, WAITING, INTERRUPTED = 0, 1, 2, 3, 130  # exit statuses


def python() -> str:
    """The Python that runs, as it is typed in the working folder."""
    executable = Path(sys.executable)
    if shutil.which("python") == str(executable):
        return "python"
    inside = executable.is_relative_to(Path.cwd())
    return shlex.quote(os.path.relpath(executable) if inside else str(executable))


def add_own_components(parser: argparse.ArgumentParser) -> None:
    """Let a command line take configs and components of the user's own."""
    parser.add_argument(
        "--config-dir", metavar="DIR", help="a folder with groups, options and sweeps/ of your own"
    )
    parser.add_argument(
        "--allow",
        metavar="MODULE",
        action="append",
        default=[],
        help="also let configs name classes of this module, as of those next to DIR; may be repeated",
    )
