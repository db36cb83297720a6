"""A sweep's grid: from a composed config to the list of its trials. Nothing runs here."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, Required

from pydantic import Field

from simbias.config import Composition, ConfigError, Variations
from simbias.config.allowed import Own, leaves
from simbias.config.build import build_task
from simbias.config.components import construct, validate
from simbias.config.composition import NOT_HASHED
from simbias.config.hydra_config import overridden
from simbias.core.digest import short_digest
from simbias.core.ranges import FigureWidth, Share
from simbias.sweep.axes import Axis, in_words, label, read_axis
from simbias.sweep.figure import SweepFigure
from simbias.sweep.statistics import BAR

MOST_TRIALS = 100_000  # of a sweep: more take minutes to list, and years to run
LASTS = "lasts for the task's horizon without a failure"  # of a test episode, if the task defines no success
SEED_DIGITS = 12  # hexadecimal: enough to avoid collisions of seeds
FileName = Annotated[str, Field(pattern=r"^\w[\w-]*$")]
Measure = Literal[
    "experiments",
    "iterations",
    "succeeded",
    "hardware_seconds",
    "success_rate",
    "reliable",
    "holds",
    "long_success_rate",
    "paper",
]
# Defaults, if none are named.
FIGURES = {"experiments": {"_target_": "simbias.sweep.figures.experiments.Experiments"}}


@dataclass(frozen=True)
class Report:
    """Columns and measures of a sweep's table."""

    columns: str | None  #: the axis whose points are columns
    measures: tuple[Measure, ...]  #: shown for each cell
    paper: Mapping[tuple[str, ...], float]  #: labels of a cell -> the paper's mean number of experiments
    bar: float = BAR  #: share of starts that a policy must hold, by the bound from its test episodes


@dataclass(frozen=True)
class Cell:
    """A point of the grid: a config without its seed."""

    labels: tuple[str, ...]  #: one for each axis
    composition: Composition
    identity: str  #: determines its trials' seeds; cells that share it have common random numbers


@dataclass(frozen=True)
class Trial:
    """A repetition of a cell."""

    cell: Cell
    repetition: int
    seed: int

    @property
    def composition(self) -> Composition:
        """The trial's config; all except the seed is shared with the cell's other trials."""
        return replace(self.cell.composition, config={**self.cell.composition.config, "seed": self.seed})

    @cached_property
    def hash(self) -> str:
        """The trial's identity, as for a single study."""
        return self.cell.composition.hash_with({"seed": self.seed})

    @property
    def name(self) -> str:
        """The trial's name in a few words."""
        return " ".join([*self.cell.labels, f"#{self.repetition}"])


@dataclass(frozen=True)
class Sweep:
    """A grid of trials, with its report and figures."""

    name: str
    base: Composition  #: the config shared by all trials, with the axes' keys at their base values
    axes: tuple[Axis, ...]
    cells: tuple[Cell, ...]  #: the last axis changes fastest
    repetitions: int
    dry_run: bool
    report: Report
    figures: Mapping[str, SweepFigure]  #: by the name of their files
    figures_to: str | None  #: folder in the working folder for copies of the files

    @cached_property
    def trials(self) -> tuple[Trial, ...]:
        """The first trial of each cell, then the second of each, and so on, so that all cells fill evenly."""
        base_seed = self.base.config["seed"]
        return tuple(
            Trial(cell, repetition, trial_seed(cell.identity, base_seed, repetition))
            for repetition in range(self.repetitions)
            for cell in self.cells
        )

    def words(self, labels: Sequence[str]) -> str:
        """A cell in words, by its labels."""
        return in_words(self.axes, labels)

    @cached_property
    def success(self) -> str:
        """When a test episode counts as a success, as a verb phrase about its policy."""
        cells = {repr(cell.composition.config["task"]): cell.composition for cell in self.cells}
        said = {build_task(cell.config["task"], cell.own).says_success for cell in cells.values()}
        if len(said) > 1:
            return f"succeeds ({LASTS}, if its task has no success of its own)"
        return "succeeds" if said == {True} else LASTS

    @property
    def hash(self) -> str:
        """Identity by name, axes, seeds, split, shared config; a sweep is open to new points and trials."""
        values = self.base.config["sweep"]
        split, common_seeds = values.get("suite", {}).get("split"), sorted(values.get("common_seeds", []))
        specs = values["axes"].items()  # no keys of named points: a new point may set others
        axes = [[name, spec.get("keys")] if isinstance(spec, Mapping) else name for name, spec in specs]
        shared = [self.name, axes, common_seeds, split, self.base.trial.hash]
        return short_digest(json.dumps(shared).encode())


def trial_seed(cell: str, base_seed: int, repetition: int) -> int:
    """The seed of a repetition, derived from its own identity, independent of other cells and trials."""
    text = f"{cell} {base_seed} {repetition}"
    return int(hashlib.sha256(text.encode()).hexdigest()[:SEED_DIGITS], 16)


def expand(
    overrides: Sequence[str], config_dir: Path | str | None = None, allow: Sequence[str] = ()
) -> Sweep:
    """The grid described by `+sweep=NAME` and further overrides.

    Raises
    ------
    ConfigError
        If the sweep, an axis or a value is bad. The components of cells are not built, and so not checked.
    """
    return expanded(Variations(overrides, config_dir, allow))


def expanded(variations: Variations) -> Sweep:
    """The grid of a command line whose compositions are already known; errors as for `expand`."""
    base = variations.composition({})
    values = _specification(base)
    axes = tuple(read_axis(name, spec) for name, spec in values["axes"].items())
    _check_size(axes, values["trials"])
    _check_keys(axes, variations.overrides, base.choices.keys())
    cells = tuple(_cells(axes, _common_seeds(values, axes), variations))
    return Sweep(
        name=base.choices.get("sweep", "sweep"),
        base=base,
        axes=axes,
        cells=cells,
        repetitions=values["trials"],
        dry_run=values.get("dry_run", False),
        report=_report(values.get("report", {}), axes),
        figures=dict(_figures(values, cells, base.own)),
        figures_to=values.get("figures_to"),
    )


def _specification(base: Composition) -> dict[str, Any]:
    """The config's node `sweep`, checked."""
    node = base.config["sweep"]
    if not isinstance(node, Mapping):
        raise ConfigError("sweep", f"must be a mapping, got {node!r}")
    fields = {
        "trials": Required[Annotated[int, Field(gt=0, le=MOST_TRIALS)]],
        "axes": Required[dict[str, Any]],
        "suite": NotRequired[dict[str, Any]],  # referred to by axes through interpolation
        "common_seeds": NotRequired[list[str]],
        "dry_run": NotRequired[bool],
        "report": NotRequired[dict[str, Any]],
        "figures": NotRequired[dict[FileName, Any]],
        "figures_to": NotRequired[str | None],
        "figures_width": NotRequired[FigureWidth | None],
    }
    return validate(node, fields, "sweep")


def _check_size(axes: Sequence[Axis], trials: int) -> None:
    """Refuse an absurdly large sweep before it is expanded."""
    cells = math.prod(len(axis.points) for axis in axes)
    if cells * trials > MOST_TRIALS:
        problem = f"{cells} cells of {trials} trials are more than {MOST_TRIALS} trials"
        raise ConfigError("sweep.trials", problem)


def _check_keys(axes: Sequence[Axis], overrides: Sequence[str], groups: Collection[str]) -> None:
    """Refuse keys set by two axes, and overrides of keys set by an axis, which would have no effect."""
    owners: dict[str, str] = {"seed": ""}
    for axis in axes:
        for key in axis.keys:
            if (root := key.partition(".")[0]) in NOT_HASHED:
                raise ConfigError(f"sweep.axes.{axis.name}", f"{root} does not change any trial's result")
            for other, owner in owners.items():
                if _overlap(key, other, groups):
                    problem = f"{key} is set elsewhere: {owner or 'each trial has its own'}"
                    raise ConfigError(f"sweep.axes.{axis.name}", problem)
        owners |= dict.fromkeys(axis.keys, axis.name)
        for key, value in (each for point in axis.points for each in point.values.items()):
            if (group := key.lstrip("+")) in groups and isinstance(value, Mapping):
                inner = next(iter(value), "key")
                problem = f"{group} is a group; its values must be options, or write {key}.{inner}"
                raise ConfigError(f"sweep.axes.{axis.name}", problem)
    for override in overridden(overrides):
        for key, axis_name in owners.items():
            if key != "seed" and _overlap(override, key, groups):
                raise ConfigError(
                    override, f"is an axis of the sweep; its values are in sweep.axes.{axis_name}"
                )


def _overlap(key: str, other: str, groups: Collection[str]) -> bool:
    """Whether two keys are the same or one contains the other; values in an option may be changed."""
    outer, inner = sorted((key, other), key=len)
    return inner == outer or (inner.startswith(f"{outer}.") and outer not in groups)


def _common_seeds(values: Mapping[str, Any], axes: Sequence[Axis]) -> frozenset[str]:
    """The axes with common seeds: repetition i has the same seed at all their points."""
    names = [axis.name for axis in axes]
    for name in (chosen := values.get("common_seeds", [])):
        if name not in names:
            raise ConfigError("sweep.common_seeds", f"no such axis: {name}; available: {', '.join(names)}")
    return frozenset(chosen)


def _cells(axes: Sequence[Axis], common_seeds: frozenset[str], variations: Variations) -> Iterator[Cell]:
    """Every combination of the axes' points."""
    known: dict[str, tuple[str, ...]] = {}
    identities: dict[str, str] = {}  # by the settings that determine seeds
    for points in itertools.product(*(axis.points for axis in axes)):
        settings: dict[str, Any] = {}
        seeding: dict[str, Any] = {}
        for axis, point in zip(axes, points, strict=True):
            settings |= point.values
            seeding |= {} if axis.name in common_seeds else point.values
        composition = _composed(variations, settings, axes)
        labels = tuple(point.label for point in points)
        twin = known.setdefault(composition.group_hash, labels)
        if twin != labels:
            raise ConfigError("sweep.axes", f"{' '.join(twin)} and {' '.join(labels)} are the same config")
        if (key := repr(seeding)) not in identities:
            identities[key] = variations.trial(seeding).group_hash if common_seeds else composition.group_hash
        yield Cell(labels, composition, identities[key])


def _composed(variations: Variations, settings: Mapping[str, Any], axes: Sequence[Axis]) -> Composition:
    """The composition of a cell's trials; for an unknown key, the error names the axis."""
    try:
        return variations.trial(settings)
    except ConfigError as error:
        for axis in axes:
            if error.key in axis.keys and error.problem.startswith("no such key"):
                raise ConfigError(f"sweep.axes.{axis.name}.keys", str(error)) from error
        raise


def _report(spec: Mapping[str, Any], axes: Sequence[Axis]) -> Report:
    """The report of a config, checked against the axes."""
    fields = {
        "columns": NotRequired[str | None],
        "measures": NotRequired[list[Measure]],
        "paper": NotRequired[dict[Any, Any] | None],
        "bar": NotRequired[Annotated[Share, Field(lt=1)]],
    }
    checked = validate(spec, fields, "sweep.report")
    columns = checked.get("columns")
    names = [axis.name for axis in axes]
    if columns is not None and columns not in names:
        raise ConfigError("sweep.report.columns", f"no such axis: {columns}; available: {', '.join(names)}")
    paper = {tuple(map(label, path)): value for path, value in leaves(checked.get("paper") or {})}
    for labels, value in paper.items():
        if len(labels) != len(axes) or not isinstance(value, int | float):
            raise ConfigError(
                "sweep.report.paper", f"must have a number for the labels of {', '.join(names)}, got {labels}"
            )
    measures = checked.get("measures", ["experiments", "succeeded", *(["paper"] if paper else [])])
    return Report(columns, tuple(measures), paper, checked.get("bar", BAR))


def _figures(values: Mapping[str, Any], cells: Sequence[Cell], own: Own) -> Iterator[tuple[str, SweepFigure]]:
    """The figures, by the name of their files; arguments named `task`, `cells` and `width` are provided."""
    specs = values.get("figures", FIGURES if values["axes"] else {})
    width = {"width": values["figures_width"]} if values.get("figures_width") else {}
    first = cells[0].composition
    task = build_task(first.config["task"], first.own)
    for name, spec in specs.items():
        yield (
            name,
            construct(spec, SweepFigure, f"sweep.figures.{name}", own, task=task, cells=cells, **width),
        )
