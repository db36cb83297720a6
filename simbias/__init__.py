"""Learn the bias between a simulation and the hardware; optimise policies with few hardware experiments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.sweep.running import SweepObserver
    from simbias.trial.run import RecordedTrial
    from simbias.trial.study import Study

__version__ = "0.1.0"


def load(
    overrides: Sequence[str] = (), config_dir: Path | str | None = None, allow: Sequence[str] = ()
) -> Study:
    """Compose a study with the same overrides as on the command line.

    >>> study = load(["bias=none", "hardware.noise.torque_variance=0.1", "seed=3"])

    Components of your own are beside `config_dir`, or in modules that `allow` names.

    Raises
    ------
    simbias.config.ConfigError
        If an override or a value is bad; the message is one line that names the key.
    """
    from simbias.config import compose  # lazily: the command line's --help needs no components
    from simbias.config.build import build

    return build(compose(overrides, config_dir, allow))


def load_trial(
    run_id: str,
    uri: str = "sqlite:///mlflow.db",
    config_dir: Path | str | None = None,
    allow: Sequence[str] = (),
) -> RecordedTrial:
    """Read a trial back from a store: its study and its iterations; components of your own as for `load`.

    Raises
    ------
    simbias.config.ConfigError
        If the store has no such trial; the message is one line.
    """
    from simbias.mlflow import trials

    return trials.load_trial(run_id, uri, config_dir, allow)


def run_sweep(
    overrides: Sequence[str],
    config_dir: Path | str | None = None,
    observer: SweepObserver | None = None,
    allow: Sequence[str] = (),
) -> DataFrame:
    """Run a sweep, or go on with it; return its trials, a row for each.

    >>> trials = run_sweep(["+sweep=smoke", "engine=sequential"])

    Raises
    ------
    simbias.config.ConfigError
        If anything is bad about the sweep; nothing has run then.
    """
    from simbias.sweep import running

    return running.run(overrides, config_dir, observer, allow)
