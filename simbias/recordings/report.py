"""The page of an assessment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from simbias.pictures.elements.html import heading, items, page, paragraph, picture, table
from simbias.recordings import plots, words
from simbias.recordings.assessment import Assessment
from simbias.recordings.excitation import Excitation

MOST = 5  # maximum number of drawn parts


def report(assessment: Assessment, excitation: Excitation | str, notes: Sequence[str] = ()) -> str:
    """The report of an assessment, as HTML in one file, with notes on its recordings."""
    return page(
        f"{assessment.study.choices['task']}, identified from recordings",
        _parts(assessment, excitation, notes),
    )


def _parts(assessment: Assessment, excitation: Excitation | str, notes: Sequence[str]) -> Iterator[str]:
    """The parts of the page, from the verdict to the predictions."""
    yield paragraph(words.verdict(assessment))
    yield paragraph(words.sources(assessment))
    yield heading("Which parameter may be trusted?")
    yield table(words.PARAMETER_NAMES, words.parameter_rows(assessment))
    yield paragraph(words.TRUST)
    yield picture(
        plots.parameters(assessment), "Prior, posterior and the estimate of each part, by parameter"
    )
    if own := list(words.own_lines(assessment)):
        yield heading("Parameters specific to each recording")
        yield items(own)
    yield heading("What the data do not determine")
    lines = list(words.undetermined_lines(assessment))
    yield (
        items(lines)
        if lines
        else paragraph("The data determine all directions of the parameters that recordings share.")
    )
    yield heading("Prediction errors on data that were not fitted")
    yield table(words.error_names(assessment), words.error_rows(assessment))
    yield paragraph(words.about_errors(assessment))
    if outside := list(words.reach_lines(assessment)):
        yield paragraph("Some predictions extrapolate beyond the data that their model was fitted to:")
        yield items(outside)
    yield picture(plots.errors(assessment), "Root mean square errors by horizon")
    if notes:
        yield heading("How the recordings were processed")
        yield items(notes)
    yield heading("What to record next")
    yield items(words.advice(assessment, excitation))
    yield heading("Predictions and measurements")
    yield paragraph(
        "Every second, a prediction starts at the measured state and follows the measured inputs. "
        f"Of the longest piece between gaps, at most the first {plots.DRAWN:g} s are shown."
    )
    for i, part in enumerate(assessment.judged[:MOST]):
        of = f" ({', '.join(part.pieces)})" if assessment.held_out else ""
        yield paragraph(f"{part.name}{of}")
        yield picture(plots.forecasts(assessment, i), f"{part.name}: measured and predicted states")
