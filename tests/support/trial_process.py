"""A trial in a process of its own, to be killed; its working folder is that of the trial's."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path


def start(folder: Path, overrides: Sequence[str], conf: Path) -> BaseProcess:
    """Start it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["simbias.config.build", "simbias.robots.bongoboard.pymunk"])
    process = context.Process(target=_run, args=(folder, list(overrides), conf))
    process.start()
    return process


def _run(folder: Path, overrides: Sequence[str], conf: Path) -> None:
    """Run or resume the trial."""
    import simbias
    from simbias.trial.run import run_trial

    os.chdir(folder.parent)
    run_trial(simbias.load(overrides, conf), folder)
