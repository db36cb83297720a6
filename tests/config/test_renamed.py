"""What had another name before is one line that tells the new one, wherever it is given."""

import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from errors import one_line
from shipped import shipped
from texts import write

import simbias
from simbias.config import compose, options
from simbias.config.renamed import RENAMED, new_name
from simbias.sweep.grid import expand

RENAMES = {
    "bias.reach": "bias.d",
    "bias=gaussian": "bias=gp",
    "old_group": "optimizer",
}


def test_new_names_exist_and_old_ones_do_not() -> None:
    for old, new in RENAMED.items():
        assert _exists(new_name(old) or ""), new
        assert not _exists(old), old
    assert list(RENAMED) == sorted(RENAMED)


def _exists(name: str) -> bool:
    """Whether there is such an option or key."""
    group, equals, option = name.partition("=")
    if equals:
        return option in options().get(group, [])
    group = name.partition(".")[0]
    names = options().get(group, [])
    found = [compose().config, *({group: shipped(group, each)} for each in names if group != "preset")]
    return any(_has(config, name.split(".")) for config in found)


def _has(config: object, parts: list[str]) -> bool:
    """Whether a config has a key."""
    return not parts or (
        isinstance(config, Mapping) and parts[0] in config and _has(config[parts[0]], parts[1:])
    )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of configs, while there are a few renames more."""
    for old, new in RENAMES.items():
        monkeypatch.setitem(RENAMED, old, new)
    return tmp_path


def test_on_the_command_line(folder: Path) -> None:
    for override, line in {
        "bias.reach=2": "bias.reach: is now bias.d",
        "+bias.reach=2": "bias.reach: is now bias.d",
        "bias=gaussian": "bias=gaussian: is now bias=gp",
        "old_group.seed=3": "old_group.seed: is now optimizer.seed",
    }.items():
        with one_line(f"^{line}$"):
            simbias.load([override, "tracking=none"])


def test_in_a_file(folder: Path) -> None:
    head = "# @package _global_\n"
    for group, text, line in (
        ("preset", f"{head}bias: {{reach: 2}}", "bias.reach: is now bias.d"),
        ("preset", f"{head}old_group: {{a: 2}}", "is now optimizer.a"),
        ("preset", f"{head}defaults: [{{override /bias: gaussian}}]", "=gp"),
        ("preset", f"{head}defaults: [{{override /old_group: a}}]", "optimi"),
        ("sweeps", "sweep: {trials: 1, axes: {bias.reach: [1, 2]}}", "is now bias.d"),
        ("sweeps", "sweep: {trials: 1, axes: {bias: [gaussian]}}", "is now bias=gp"),
    ):
        write(folder, {f"{group}/mine.yaml": text})
        use, chosen = (simbias.load, "preset=mine") if group == "preset" else (expand, "+sweep=mine")
        with one_line(re.escape(line)):
            use([chosen, "tracking=none"], folder)  # type: ignore[operator]
