"""Comparing records and folders of trials."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from simbias.trial.folder import TrialFolder
from simbias.trial.run import TrialRecord

DERIVED = ("model", "study", "traceback")  # follow from the rest


def assert_equal(a: Any, b: Any, where: str = "") -> None:
    """Two records are the same to the last bit, but for what follows from the rest."""
    if isinstance(b, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=where)
    elif is_dataclass(b):
        assert type(a) is type(b), where
        for field in fields(b):
            if field.name not in DERIVED:
                assert_equal(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(b, tuple):
        assert len(a) == len(b), where
        for index, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_equal(one, other, f"{where}[{index}]")
    elif isinstance(b, Mapping):
        assert dict(a) == dict(b), where
    else:
        assert a == b or (a != a and b != b), where


def timeless(record: TrialRecord) -> TrialRecord:
    """A record without its times."""
    iterations = tuple(replace(iteration, seconds={}) for iteration in record.iterations)
    return replace(record, iterations=iterations, summary=replace(record.summary, ended=0.0, seconds=0.0))


def made(names: Sequence[str]) -> int:
    """How many of these steps the hardware has made: experiments, and episodes of a test."""
    return names.count("experiment") + names.count("test_episode")


def step_names(folder: Path) -> list[str]:
    """The steps of a trial's folder, `search`, `experiment`, `iteration` or `test_episode`."""
    return [file.stem.partition("_")[2] for file in TrialFolder(folder).steps()]
