"""The suite by which methods are compared: its split, its bar and its cells."""

from __future__ import annotations

import pytest

from simbias.config import ConfigError
from simbias.sweep.axes import read_axis
from simbias.sweep.grid import Sweep, expand


def split(name: str) -> Sweep:
    return expand(["+sweep=suite", f"sweep.suite.split={name}"])


@pytest.mark.slow
def test_no_cell_is_for_development_and_for_the_test() -> None:
    """Nor are the starts of the test the same."""
    development, test = split("development"), split("test")
    hashes = [{cell.composition.group_hash for cell in each.cells} for each in (development, test)]
    assert not hashes[0] & hashes[1]
    assert [len(each) for each in hashes] == [11, 11]
    seeds = {each.base.config["policy_test"]["seed"] for each in (development, test)}
    assert len(seeds) == 2


def test_episodes_are_enough_to_pass_the_bar_and_last_a_minute() -> None:
    from simbias.sweep.statistics import holds

    sweep = split("test")
    test = sweep.base.config["policy_test"]
    assert holds("1" * test["episodes"], sweep.report.bar)
    assert test["long_episodes"] == test["episodes"]
    assert test["long_seconds"] == 60


def test_every_bongoboard_of_the_suite_has_noise_and_records_what_is_measured() -> None:
    for cell in (*split("development").cells, *split("test").cells):
        hardware = cell.composition.config["hardware"]
        if "gaps" in hardware:
            assert hardware["record"] == "measured"
            assert min(hardware["noise"].values()) > 0


def test_points_need_not_set_the_same_keys() -> None:
    axis = read_axis("cell", {"points": {"a": {"bias": "none"}, "b": {"seed": 3, "+hardware.x": 1}}})
    assert axis.keys == ("bias", "seed", "hardware.x")
    assert axis.labels == ("a", "b")
    with pytest.raises(ConfigError, match=r"^sweep\.axes\.cell\.points\.a: "):
        read_axis("cell", {"points": {"a": 1}})
    with pytest.raises(ConfigError, match=r"^sweep\.axes\.cell: has no values"):
        read_axis("cell", {"points": {}})
