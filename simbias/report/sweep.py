"""The page of a sweep."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from simbias.core import markdown
from simbias.core.proportions import counted_share, wilson
from simbias.pictures.elements.html import heading, image, page, paragraph, table
from simbias.report.parts import made_with
from simbias.sweep.folder import SweepFolder
from simbias.sweep.tables import left_out
from simbias.trial.folder import TrialFolder
from simbias.trial.summary import TrialSummary

MOST_ROWS = 1000  # of a table on the page


def sweep_page(folder: SweepFolder) -> str:
    """The report of a sweep, ended or not, as HTML in one file.

    Raises
    ------
    ConfigError
        If its description or a trial's outcome cannot be read.
    """
    description = folder.description()
    return page(f"Sweep {description['name']}", _parts(folder, description))


def _parts(folder: SweepFolder, description: dict) -> Iterator[str]:
    """From how far it is to the config."""
    summaries = [TrialFolder(folder.trials / name).summary() for name in description["trials"]]
    begun = [summary for summary in summaries if summary is not None]
    ended = [summary for summary in begun if summary.outcome.final]
    planned = len(description["trials"])
    succeeded = sum(str(summary.outcome) == "succeeded" for summary in ended)
    yield paragraph(
        f"{len(ended)} of {planned} trials have ended; of these succeeded "
        f"{counted_share(succeeded, len(ended))}.{left_out(str(each.outcome) for each in begun)}"
    )
    yield from _claims(ended)
    for file in folder.figures():
        if file.suffix == ".png":
            caption = file.with_suffix(".md")
            words = " ".join(caption.read_text(encoding="utf-8").split()) if caption.is_file() else file.stem
            yield heading(file.stem)
            yield image(file.read_bytes(), words)
            yield paragraph(words)
            if (numbers := file.with_suffix(".csv")).is_file():
                frame = pd.read_csv(numbers, dtype=str, keep_default_na=False)
                told = frame.loc[:, (frame != "").any()]  # not of what no cell has
                yield from _table(list(told.columns), told.to_numpy().tolist())
    if "table" in (state := folder.state()):
        yield heading("Cells")
        yield paragraph(str(state["legend"]))
        head, *rows = markdown.cells(state["table"])
        yield from _table(head, rows)
    yield from made_with(description)


def _claims(ended: list[TrialSummary]) -> Iterator[str]:
    """How many trials claim more than the test of their last policies bears out."""
    tested = [each for each in ended if each.claim and each.test_episodes]
    if not tested:
        return
    wrong = 0
    for each in tested:
        episodes = each.test_episodes
        wrong += wilson(episodes.count("1"), len(episodes)).high < each.claimed_share
    yield paragraph(
        f"Of trials that claim a share of starts, by their own experiments at 95% confidence, the test of "
        f"the last policy contradicts {counted_share(wrong, len(tested))}."
    )


def _table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    """A table, if it is not too long to be read."""
    if len(rows) <= MOST_ROWS:
        yield table(head, rows)
