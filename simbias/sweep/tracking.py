"""Tracking of trials: their folders, and the store to which they are exported."""

from __future__ import annotations

from pathlib import Path

from simbias.engine.workplace import workplace
from simbias.sweep.folder import SweepFolder
from simbias.trial.observer import Observer


class Export(Observer):
    """Shows a trial or a sweep elsewhere, from its folder; the base class shows nothing."""

    def __init__(self, where: str = "") -> None:
        self._where = where

    @property
    def where(self) -> str:
        """One line about how to view the kept trial."""
        return self._where

    def update(self, final: bool = False) -> None:
        """Update it from the folder; `final` means that nothing more follows."""

    def trial_ended(self, folder: Path) -> None:
        """A trial of the sweep has ended or stopped."""


class Tracking:
    """Keeps trials in folders; a subclass may also show them elsewhere."""

    folder: Path | None = None  # contains each trial's folder, named by its hash; None: nothing is kept
    pictures: bool = False  # whether pictures are drawn for each finished trial

    def trial_folder(self, identity: str) -> Path | None:
        """The folder of the trial with this hash; None if nothing is kept."""
        return None if self.folder is None else self.folder / identity

    def sweep_folder(self, name: str, identity: str) -> SweepFolder:
        """The folder of the sweep with this name and hash; a temporary one if nothing is kept."""
        return SweepFolder((self.folder or workplace()) / "sweeps" / f"{name}_{identity}")

    def export_trial(self, folder: Path) -> Export:
        """Show a trial elsewhere.

        Raises
        ------
        ConfigError
            If the store cannot be used.
        """
        return Export(str(folder))

    def export_sweep(self, folder: SweepFolder) -> Export:
        """Show a sweep elsewhere; errors as for `export_trial`."""
        return Export(str(folder.path) if self.folder else "")


class Folders(Tracking):
    """Trials in folders, shown nowhere else.

    Parameters
    ----------
    trials
        Folder of the trials.
    pictures
        Whether pictures are drawn for each finished trial; in sweeps, for the first trial of each cell.
    """

    def __init__(self, trials: str = "trials", pictures: bool = True) -> None:
        self.folder = Path(trials)
        self.pictures = pictures


class NoTracking(Tracking):
    """Keeps nothing."""
