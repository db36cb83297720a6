"""Exit statuses, and commands that a person can paste."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

SUCCEEDED, FAILED, BAD_INPUT, WAITING, INTERRUPTED = 0, 1, 2, 3, 130  # exit statuses


def python() -> str:
    """The running Python interpreter, as a user would type it in the working folder."""
    executable = Path(sys.executable)
    if shutil.which("python") == str(executable):
        return "python"
    inside = executable.is_relative_to(Path.cwd())
    return shlex.quote(os.path.relpath(executable) if inside else str(executable))
