"""Report pages of trials and sweeps, written into their folders."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from threadpoolctl import threadpool_limits

from simbias.config.stored import read_folder
from simbias.core import markdown
from simbias.core.errors import ConfigError
from simbias.core.messages import counted, printable
from simbias.core.proportions import counted_share, wilson
from simbias.pictures.elements import html
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.trial.gallery import FIGURES
from simbias.sweep.folder import CHANGED, SWEEP, SweepFolder, sweep_folders
from simbias.sweep.results import SHOWN
from simbias.sweep.tables import left_out
from simbias.trial.continuation import continued
from simbias.trial.disk import write_whole
from simbias.trial.folder import TRIAL, TrialFolder
from simbias.trial.run import TrialRecord
from simbias.trial.summary import COLUMNS, IDENTIFIED, PARAMETERS, TrialSummary, cells, parameters

FILE = "report.html"
MOST_ROWS = 1000  # of a sweep's table on the page
TOLD = ("hash", "user", "commit", "changed", "command")  # items of a description, shown in words
CHANGED_CODE = "Code or files have changed since the trial began ({}); pictures are drawn with the new ones"


def write_report(folder: Path, config_dir: Path | str | None = None, allow: Sequence[str] = ()) -> list[Path]:
    """Write `report.html` into a trial's or a sweep's folder, or into those of all sweeps beside trials.

    ConfigError if the folder is and holds neither, or cannot be read or written.
    """
    alone = [folder] if (folder / TRIAL).is_file() or (folder / SWEEP).is_file() else []
    folders = alone or [sweep.path for sweep in sweep_folders(folder)]
    if not folders:
        raise ConfigError(str(folder), "is not the folder of a trial or sweep, such as trials/7a29f4c5425f")
    for own in folders:  # checked before minutes of drawing
        if not os.access(own, os.W_OK):
            raise ConfigError(str(own / FILE), f"cannot be written ({os.strerror(errno.EACCES)})")
    for own in folders:
        trial = (own / TRIAL).is_file()
        page = trial_page(own, config_dir, allow) if trial else sweep_page(SweepFolder(own))
        try:
            write_whole(own / FILE, page.encode())
        except OSError as error:
            raise ConfigError(str(own / FILE), f"cannot be written ({error.strerror})") from error
    return [own / FILE for own in folders]


def trial_page(folder: Path, config_dir: Path | str | None, allow: Sequence[str]) -> str:
    """The report of a trial, finished or not, as HTML in one file; errors as for `simbias.load_trial`."""
    record = read_folder(folder, config_dir, allow)
    with threadpool_limits(1, user_api="blas"):  # as when the trial ran
        return html.page(record.study.title, _trial_parts(record, TrialFolder(folder)))


def _trial_parts(record: TrialRecord, folder: TrialFolder) -> Iterator[str]:
    """The parts of a trial's page, from the verdict to the config."""
    summary = record.summary
    yield html.paragraph(f"{summary.outcome.verdict} after {summary.effort}. {summary.reason}")
    for finding in summary.findings:
        yield html.paragraph(finding)
    changed = [CHANGED_CODE.format(record.changed_code)] if record.changed_code else []
    notes = [*continued(folder), *changed, *summary.diagnostics, *map(str, record.withdrawn)]
    if notes:
        yield html.items(notes)
    yield html.heading("Iterations")
    iterations = folder.iterations()
    yield html.table(COLUMNS, map(cells, iterations))
    if identified := parameters(iterations):
        yield html.heading("Identified parameters of the last policy's model")
        yield html.table(PARAMETERS, identified)
        yield html.paragraph(IDENTIFIED)
    for name, draw in FIGURES.items() if record.iterations else ():
        try:
            figure = draw(record.study, record.iterations)
        except NoPictureError:
            continue
        except Exception as error:  # a failing picture must not prevent the page
            yield html.paragraph(f"{name}: no picture ({type(error).__name__}: {error})")
        else:
            yield html.heading(name.replace("_", " ").capitalize())
            yield html.picture(figure, name.replace("_", " "))
    yield from _made_with(folder.description())


def sweep_page(folder: SweepFolder) -> str:
    """The report of a sweep, finished or not, as HTML in one file; ConfigError for an unreadable file."""
    description = folder.description()
    return html.page(f"Sweep {description['name']}", _sweep_parts(folder, description))


def _sweep_parts(folder: SweepFolder, description: dict) -> Iterator[str]:
    """The parts of a sweep's page, from its progress to the config."""
    summaries = {name: TrialFolder(folder.trials / name).summary() for name in description["trials"]}
    shown = {name: each for name, each in summaries.items() if each is not None and each.outcome in SHOWN}
    state = folder.state()
    counts = Counter(state.get("outcomes", [str(each.outcome) for each in shown.values()]))  # as its table
    ended = counts.total() - counts["error"]
    yield html.paragraph(
        f"{ended} of {len(summaries)} trials have ended; of these, "
        f"{counts['succeeded']} succeeded.{left_out(counts.elements())}"
    )
    if folder.changed():
        yield html.paragraph(CHANGED)
    yield from _claims(list(shown.values()))
    for file in folder.figures():
        if file.suffix == ".png":
            caption = file.with_suffix(".md")
            words = " ".join(caption.read_text(encoding="utf-8").split()) if caption.is_file() else file.stem
            yield html.heading(file.stem)
            yield html.image(file.read_bytes(), words)
            yield html.paragraph(words)
            drawn = state.get("drawn", {}).get(file.stem, counts.total())
            if drawn != counts.total():
                yield html.paragraph(
                    f"Drawn from {counted(drawn, 'trial')}; it is drawn again once all have ended."
                )
            if (numbers := file.with_suffix(".csv")).is_file():
                frame = pd.read_csv(numbers, dtype=str, keep_default_na=False)
                told = frame.loc[:, (frame != "").any()]  # without columns that are empty in all cells
                yield from _table(list(told.columns), told.to_numpy().tolist())
    if "table" in state:
        yield html.heading("Cells")
        yield html.paragraph(str(state["legend"]))
        head, *rows = markdown.cells(state["table"])
        yield from _table(head, rows)
    yield from _made_with(description)


def _claims(trials: Sequence[TrialSummary]) -> Iterator[str]:
    """How many trials claim more than the tests of their last policies support."""
    claims = [(each.holding_episodes, each.claimed_share) for each in trials if each.claim]
    tested = [(held, share) for held, share in claims if held]
    if not tested:
        return
    wrong = sum(wilson(held.count("1"), len(held)).high < share for held, share in tested)
    yield html.paragraph(
        f"Of trials that claim a share of starts, by their own experiments at 95% confidence, the test of "
        f"the last policy contradicts {counted_share(wrong, len(tested))}: too few of its episodes last as "
        "long as an experiment."
    )


def _table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    """A table, unless it is too long to read."""
    if len(rows) <= MOST_ROWS:
        yield html.table(head, rows)


def _made_with(description: Mapping[str, Any]) -> Iterator[str]:
    """Config, versions and code."""
    yield html.heading("How it was made")
    lines = [f"{name}: {description[name]}" for name in TOLD if description.get(name)]
    lines += [f"{name} {version}" for name, version in description.get("versions", {}).items()]
    lines += [f"{name}: own code or file, {digest}" for name, digest in description.get("code", {}).items()]
    yield html.items(printable(line) for line in lines)
    yield html.heading("Config")
    config = description.get("config", {})
    yield html.preformatted(yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
