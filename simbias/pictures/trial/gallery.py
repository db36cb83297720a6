"""All pictures of a trial, as files."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from simbias.core.errors import ConfigError
from simbias.core.records import Iteration
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.style import SMALL, png, publish
from simbias.pictures.trial.animation import save_animation
from simbias.pictures.trial.costs import costs
from simbias.pictures.trial.errors import prediction_errors
from simbias.pictures.trial.following import following
from simbias.pictures.trial.forecast import forecast
from simbias.pictures.trial.overview import overview
from simbias.pictures.trial.phases import phases
from simbias.pictures.trial.rejections import rejections
from simbias.trial.disk import PART, write_whole
from simbias.trial.folder import PICTURES, Withdrawal
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study

FIGURES: dict[str, Callable[[Study, Sequence[Iteration]], Figure]] = {
    "overview": overview,
    "following": following,
    "costs": costs,
    "prediction_errors": prediction_errors,
    "forecast": forecast,
    "phases": phases,
    "rejections": rejections,
}
ANIMATION = "animation"
ALL = (*FIGURES, ANIMATION)
NONE = "none.txt"  # file written instead of pictures


def pictures(
    study: Study,
    iterations: Sequence[Iteration],
    names: Sequence[str] = ALL,
    withdrawn: Sequence[Withdrawal] = (),
) -> dict[str, bytes]:
    """The pictures of a trial as files by name, PNG and GIF; empty without iterations.

    Pictures that a task or trial cannot have are left out. If a picture fails, a warning and a text with the
    traceback replace it, as a failing picture must not end a trial.
    """
    files: dict[str, bytes] = {}
    for name in names if iterations else ():
        try:
            if name == ANIMATION:
                save_animation(study, iterations, file := BytesIO())
                files[f"{name}.gif"] = file.getvalue()
            else:
                files[f"{name}.png"] = png(_figure(name, study, iterations, withdrawn))
        except NoPictureError:
            continue
        except Exception as error:
            warnings.warn(f"picture {name}: {type(error).__name__}: {error}", RuntimeWarning, stacklevel=2)
            files[f"{name}.txt"] = traceback.format_exc().encode()
    return files


def illustrate(record: TrialRecord, folder: Path, names: Sequence[str] = ALL) -> None:
    """Draw missing pictures into the folder of a finished trial."""
    target = folder / PICTURES
    there = {file.stem for file in target.glob("*") if file.suffix != PART}
    missing = [name for name in names if name not in there]
    if not record.outcome.final or not missing:
        return
    with threadpool_limits(1, user_api="blas"):  # as when the trial ran
        files = pictures(record.study, record.iterations, missing, record.withdrawn)
    if not there and not files:
        files = {NONE: b"This trial has nothing that could be drawn.\n"}
    target.mkdir(exist_ok=True)
    for name, content in files.items():
        write_whole(target / name, content)


def save_all(
    study: Study, iterations: Sequence[Iteration], folder: Path, withdrawn: Sequence[Withdrawal] = ()
) -> list[str]:
    """Write all pictures of a trial for publication, as PNG, SVG, PDF and GIF; return the file names.

    ConfigError if no iteration has ended, or the folder cannot be made.
    """
    if not iterations:
        raise ConfigError(str(folder), "no iteration has ended, so there is nothing to draw")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(str(folder), f"no folder ({error.strerror})") from error
    files = []
    for name in FIGURES:
        with suppress(NoPictureError):
            figure = _figure(name, study, iterations, withdrawn)
            files += [path.name for path in publish(figure, folder, name)]
    with suppress(NoPictureError):
        save_animation(study, iterations, folder / f"{ANIMATION}.gif")
        files.append(f"{ANIMATION}.gif")
    return files


def _figure(
    name: str, study: Study, iterations: Sequence[Iteration], withdrawn: Sequence[Withdrawal]
) -> Figure:
    """A figure of a trial, with its withdrawn experiments noted at the bottom."""
    figure = FIGURES[name](study, iterations)
    if withdrawn:
        figure.supxlabel("; ".join(map(str, withdrawn)), fontsize=SMALL)
    return figure
