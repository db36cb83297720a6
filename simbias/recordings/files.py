"""Files of an assessment: page, tables, draws, and the model as config and MJCF."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from simbias.config import options
from simbias.core import Task
from simbias.core.errors import ConfigError
from simbias.core.messages import brief
from simbias.core.parameters import values_at
from simbias.core.records import Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.posterior import options_of_recordings
from simbias.learning.identification.rig import Rig
from simbias.recordings.assessment import Assessment
from simbias.recordings.excitation import Excitation
from simbias.recordings.findings import at_bound
from simbias.recordings.report import report
from simbias.recordings.study import GROUP
from simbias.robots.mujoco.model import Mujoco
from simbias.trial.origin import model_digest
from simbias.trial.study import Study

OPTION = "identified"
FIRST_LINE = "# What recordings say of the nominal model's parameters; a trial's experiments add to it."
DRAWS, MODELS, SEED = 100, 10, 0  # of the posterior: rows of a table, number of files
EXCITATION, OWN = "excitation.csv", "recordings.csv"
OPTIONAL = (EXCITATION, OWN, f"{OPTION}.xml", *(f"draw_{i}.xml" for i in range(MODELS)))  # not always written
MECHANICS_ALONE = "<!-- Without motors and sensors, which are in parameters.csv and draws.csv. -->\n"
OF_RECORDINGS = f"<!-- {{}} at the prior's median: each recording has its own, in {OWN}. -->\n"


def check_replaces_nothing(study: Study, folder: Path, option: Path) -> None:
    """Make the folders; refuse to overwrite a file that the study is read from.

    Raises
    ------
    ConfigError
        Naming the file; a posterior refers to that model or prior, not to its replacement.
    """
    written = {(folder / name).resolve() for name in OPTIONAL}
    for file in getattr(study.nominal, "source_files", ()):
        if Path(file).resolve() in written:
            raise ConfigError("--into", f"would replace {file}, which the nominal model is read from")
    own = option.is_file() and option.read_text(encoding="utf-8").startswith(head(folder, option))
    others = not own and option.stem in options(option.parents[1])[GROUP]
    if others or option.stem == study.choices.get(GROUP):
        raise ConfigError("--into", f"would replace {GROUP}={option.stem}: choose another folder")
    try:
        for made in folder, option.parent:
            made.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("--into", f"{made} cannot be written ({error.strerror})") from error


def write(
    assessment: Assessment,
    excitation: Excitation | str,
    identification: dict[str, Any],
    folder: Path,
    option: Path,
    notes: Sequence[str] = (),
) -> None:
    """Write everything into a folder, and the option `identification=identified` into its file.

    `excitation` may be a reason why there is none. `identification` is the config used to identify the model;
    `notes` are about the recordings.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    texts = {  # all are made before any is written or removed
        "report.html": report(assessment, excitation, notes),
        "parameters.csv": parameters(assessment).to_csv(index=False),
        "errors.csv": errors(assessment).to_csv(index=False),
        "draws.csv": draws(assessment.identified).to_csv(index=False),
    }
    if len(own := of_recordings(assessment)):
        texts[OWN] = own.to_csv(index=False)
    if isinstance(excitation, Excitation):
        told = trajectory(assessment.task, excitation.rollout)
        texts[EXCITATION] = told.to_csv(index=False, float_format="%.6g")
    texts |= {f"{name}.xml": text for name, text in models(assessment.identified)}
    lines = [head(folder, option), *option_lines(assessment, identification)]
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    option.write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name in set(OPTIONAL) - set(texts):  # files of a previous model
        (folder / name).unlink(missing_ok=True)


def parameters(assessment: Assessment) -> pd.DataFrame:
    """A row for each parameter."""
    return pd.DataFrame(
        {
            **finding.estimate._asdict(),
            "prior": finding.prior.prior,
            "prior_low": finding.prior_interval[0],
            "prior_high": finding.prior_interval[1],
            "shrinkage": finding.shrinkage,
            "at_bound": at_bound(finding.prior, finding.estimate.value),
            "correlated_with": " ".join(finding.partners),
            "trusted": finding.trusted,
            "doubts": "; ".join(finding.doubts),
        }
        for finding in assessment.findings
    )


def of_recordings(assessment: Assessment) -> pd.DataFrame:
    """A row for each recording and recording-specific parameter, such as a payload or a zero."""
    return pd.DataFrame(
        {
            "recording": name,
            **each.estimate._asdict(),
            "trusted": each.trusted,
            "doubts": "; ".join(each.doubts),
        }
        for name, found in assessment.own_findings.items()
        for each in found
    )


def errors(assessment: Assessment) -> pd.DataFrame:
    """A row for each horizon and state: root mean square errors on held-out data."""
    return pd.DataFrame(
        {
            "seconds": prediction.seconds,
            "state": state.name,
            "unit": state.unit,
            "nominal": nominal,
            "identified": identified,
            "predictions": prediction.windows,
            "coverage_90": prediction.coverage(),
        }
        for prediction in assessment.predictions
        for state, nominal, identified in zip(assessment.task.states, *prediction.rmse(), strict=True)
    )


def draws(identified: Identified) -> pd.DataFrame:
    """Draws from the posterior, a column for each parameter."""
    rng = np.random.default_rng(SEED)
    z = np.array([identified.draw_coordinates(rng) for _ in range(DRAWS)])
    names = [parameter.name for parameter in identified.parameters]
    return pd.DataFrame(values_at(identified.parameters, z), columns=names)


def models(identified: Identified) -> Iterator[tuple[str, str]]:
    """Names and texts of MJCF files of the most probable model and draws, for MuJoCo models."""
    values = draws(identified).to_numpy()[:MODELS]
    drawn = {f"draw_{i}": identified.with_parameters(each) for i, each in enumerate(values)}
    for name, model in {OPTION: identified.model, **drawn}.items():
        mechanics = model.mechanics if isinstance(model, Rig) else model
        if isinstance(mechanics, Mujoco):
            lacks = len(model.parameters) > len(mechanics.parameters)
            of_its_own = {each.name for each in identified.parameters if each.of_recording}
            own = ", ".join(each.name for each in mechanics.parameters if each.name in of_its_own)
            comments = MECHANICS_ALONE * lacks + OF_RECORDINGS.format(own) * bool(own)
            yield name, comments + mechanics.mjcf()


def trajectory(task: Task, rollout: Rollout) -> pd.DataFrame:
    """Inputs frame by frame, and the states that the model predicts."""
    table = {"time": task.time_step * np.arange(rollout.frames)}
    table |= {state.name: rollout.states[:-1, i] for i, state in enumerate(task.states)}
    return pd.DataFrame(table | {u.name: rollout.inputs[:, i] for i, u in enumerate(task.inputs)})


def head(folder: Path, option: Path) -> str:
    """The option's first lines; they name its results folder, whose runs alone may replace the option."""
    results = os.path.relpath(folder.resolve(), option.parent.resolve())
    return f"{FIRST_LINE}\n# Results: {json.dumps(results)}"


def option_lines(assessment: Assessment, identification: dict[str, Any]) -> Iterator[str]:
    """The option's lines: how it was identified, and the posterior in coordinates of declared priors."""
    identified = assessment.identified.elsewhere()
    yield "# 5% .. most probable .. 95%:"
    for e in identified.estimates:
        yield f"# {brief(e.name)}: {e.low:.5g} .. {e.value:.5g} .. {e.high:.5g} {brief(e.unit)}"
    if "differences" in identification:  # a custom class may have none
        identification = options_of_recordings(identification)
    for key, value in identification.items():
        if key != "known":
            yield f"{key}: {json.dumps(value)}"
    yield "known:"
    yield f"  parameters: {json.dumps(identified.known.parameters)}"
    yield f"  declared: {json.dumps(identified.known.declared)}"
    yield f"  model: {json.dumps(model_digest(assessment.study))}"
    doubts = [list(dict.fromkeys((*each.earlier, *each.lasting))) for each in assessment.findings]
    yield f"  doubts: {json.dumps(doubts)}"
    yield f"  learned: {json.dumps([*map(str, assessment.learned)])}"
    yield f"  mode: {json.dumps(identified.known.mode)}"
    yield "  spread:"
    for row in identified.known.spread:
        yield f"    - {json.dumps(row)}"
