"""A trial in a process of its own, to be killed; its working folder is that of the trial's."""

import faulthandler
import multiprocessing
import os
import warnings
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

import simbias
from simbias.trial.run import run_trial


def start(folder: Path, overrides: Sequence[str], conf: Path) -> BaseProcess:
    """Start it."""
    arguments = folder, list(overrides), conf
    process = multiprocessing.get_context("fork").Process(target=_run, args=arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which rest
        process.start()
    return process


def _run(folder: Path, overrides: Sequence[str], conf: Path) -> None:
    """Run or resume the trial."""
    faulthandler.disable()  # pytest's, which tells of a fault that is meant
    os.chdir(folder.parent)
    run_trial(simbias.load(overrides, conf), folder)
