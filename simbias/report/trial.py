"""The page of a trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from simbias.config.stored import read_folder
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.html import heading, items, page, paragraph, picture, table
from simbias.pictures.trial.gallery import FIGURES
from simbias.report.parts import made_with
from simbias.trial.folder import TrialFolder
from simbias.trial.run import TrialRecord
from simbias.trial.summary import COLUMNS, PARAMETERS, cells, parameters


def trial_page(folder: Path, config_dir: Path | str | None, allow: Sequence[str]) -> str:
    """The report of a trial, ended or not, as HTML in one file; errors as of `simbias.load_trial`."""
    record = read_folder(folder, config_dir, allow)
    with threadpool_limits(1, user_api="blas"):  # as when the trial ran
        return page(record.study.title, _parts(record, TrialFolder(folder)))


def _parts(record: TrialRecord, folder: TrialFolder) -> Iterator[str]:
    """From the verdict to the config."""
    summary = record.summary
    yield paragraph(f"{summary.outcome.verdict} after {summary.effort}. {summary.reason}")
    for finding in summary.findings:
        yield paragraph(finding)
    notes = [*summary.diagnostics, *map(str, record.withdrawn)]
    if notes:
        yield items(notes)
    yield heading("Iterations")
    iterations = folder.iterations()
    yield table(COLUMNS, map(cells, iterations))
    if identified := parameters(iterations):
        yield heading("Identified parameters of the last policy's model")
        yield table(PARAMETERS, identified)
    for name, draw in FIGURES.items() if record.iterations else ():
        try:
            figure = draw(record.study, record.iterations)
        except NoPictureError:
            continue
        except Exception as error:  # no page is worth losing for a picture
            yield paragraph(f"{name}: no picture ({type(error).__name__}: {error})")
        else:
            yield heading(name.replace("_", " ").capitalize())
            yield picture(figure, name.replace("_", " "))
    yield from made_with(folder.description())
