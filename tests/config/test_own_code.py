"""A trial's run knows the user's own code that it ran, and says when it has changed."""

import importlib
import io
import os
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS, ROOT
from errors import one_line
from point_mass import PointMass
from sweeping import FOLDERS, write_sweep
from texts import write

import simbias
from simbias.__main__ import main
from simbias.config import compose
from simbias.config.own_code import digests
from simbias.config.sent_code import packed
from simbias.sweep.grid import expand
from simbias.trial.folder import TrialFolder

SMALL = ["hardware=mine", "task.horizon=200", "optimizer.max_evaluations=20", *FOLDERS]
HARDWARE = """
import numpy
from my_gains import GAIN
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
own = {"__module__": __name__, "__init__": PymunkBongoboard.__init__}
Mine = type("Mine", (PymunkBongoboard,), own)
"""
SWEEP = "sweep: {trials: 1, figures: {}, axes: {hardware.inertia_error: [0.0, 0.1]}}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working folder with a hardware of one's own, in a module that imports another."""
    shipped = (ROOT / "conf" / "hardware" / "pymunk.yaml").read_text()
    own = shipped.replace("simbias.robots.bongoboard.pymunk.PymunkBongoboard", "my_hardware.Mine")
    files = {"conf/hardware/mine.yaml": own, "my_gains.py": "GAIN = 1.0\n", "unrelated.py": ""}
    write(tmp_path, files | {"my_hardware.py": HARDWARE})
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("my_hardware", "my_gains"):
        sys.modules.pop(name, None)


def test_digests_are_of_own_modules_and_what_they_import_beside(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A module that is edited after its import is named, once, until it is imported again."""
    config = simbias.load(SMALL, folder / "conf").config
    before = digests(config)
    assert before.keys() == {"my_hardware", "my_gains"}
    (folder / "my_gains.py").write_text("GAIN = 2.0\n")
    after = digests(config)
    assert {name for name in after if after[name] != before[name]} == {"my_gains"}
    assert digests(config) == after
    assert (
        caplog.text.count("my_gains was edited after Python had imported it")
        == caplog.text.count("edited")
        == 1
    )
    importlib.reload(sys.modules["my_gains"])
    assert digests(config) == after
    (folder / "my_gains.py").write_text("GAIN = 1.0\n")
    assert digests(config) == before
    assert caplog.text.count("edited") == 2
    (folder / "my_hardware.py").write_text("half of a li(")
    assert digests(config).keys() == {"my_hardware"}
    assert digests(simbias.load(["tracking=none"]).config) == {}


def test_a_package_of_ones_own_counts_its_version(folder: Path) -> None:
    package = {"__init__": "__version__ = '1.2'\n", "part": ""}
    package |= {"robot": "from . import part\nfrom my_hardware import Mine\n"}
    write(folder / "my_package", {f"{name}.py": text for name, text in package.items()})
    file = folder / "conf" / "hardware" / "mine.yaml"
    file.write_text(file.read_text().replace("my_hardware.Mine", "my_package.robot.Mine"))
    found = digests(simbias.load(SMALL, folder / "conf").config)
    own = {"my_package", "my_package.robot", "my_package.part", "my_package version"}
    assert found.keys() == own | {"my_hardware", "my_gains"}
    assert found["my_package version"] == "1.2"


@pytest.mark.slow
def test_what_ran_on_other_code_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a finished trial, and of how many of a sweep."""
    write_sweep(folder, "mine", SWEEP)
    trial = ["--config-dir", "conf", *SMALL]
    sweep = [*trial, "+sweep=mine", "engine=sequential"]
    assert main(trial) == 0
    (described,) = folder.glob("trials/*")
    assert TrialFolder(described).description()["code"].keys() == {"my_hardware", "my_gains"}
    assert main(sweep) == main(sweep) == main(trial) == 0
    assert "changed since" not in capsys.readouterr().err
    (folder / "my_gains.py").write_text("GAIN = 2.0\n")
    for command, line in (
        (trial, "the trial is shown as it was; its code or files have changed since it began (my_gains)"),
        (sweep, "2 of 2 finished trials ran on code or files that have changed since (my_gains)"),
    ):
        assert main(command) == 0
        assert line in capsys.readouterr().err
    next(folder.glob("trials/*/outcome.json")).unlink()
    main(sweep)
    said = "1 unfinished trial will resume with code or files that have changed since (my_gains)"
    assert said in capsys.readouterr().err


def test_what_is_sent_to_workers_are_files(folder: Path) -> None:
    """No pipe, and no link that leads nowhere; files may be older than 1980, as in images."""
    (folder / "conf" / "gone.yaml").symlink_to("nowhere")
    os.mkfifo(folder / "conf" / "pipe")
    os.utime(folder / "my_gains.py", (0, 0))
    with zipfile.ZipFile(io.BytesIO(packed([compose(["hardware=mine"], folder / "conf")]))) as archive:
        names = {"conf/hardware/mine.yaml", "my_gains.py", "my_hardware.py", "unrelated.py"}
        assert set(archive.namelist()) == {f"{folder.name}/{name}" for name in names}


def own_task() -> PointMass:
    """The task, as it is loaded."""
    return simbias.load([*POINT_MASS, "tracking=none"], OWN_CONF).task  # type: ignore[return-value]


def test_attributes_of_an_own_task_may_be_lists_and_integers(monkeypatch: pytest.MonkeyPatch) -> None:
    """And properties."""
    given = {"start_deviation": np.array([0, 0]), "input_limit": [8], "states": list(PointMass.states)}
    kept = {"start_deviation": np.zeros(2), "input_limit": np.array([8.0]), "states": PointMass.states}
    for name, value in given.items():
        monkeypatch.setattr(PointMass, name, value)
    for name, expected in kept.items():
        made = getattr(own_task(), name)
        assert (type(made), np.array(made).dtype) == (type(expected), np.array(expected).dtype)
        np.testing.assert_array_equal(made, expected)
    for name, value in (("states", list(PointMass.states)), ("input_limit", np.array([5]))):
        monkeypatch.setattr(PointMass, name, property(lambda _, value=value: value))
    assert own_task().input_limit == [5]
    monkeypatch.setattr(PointMass, "criteria", property(lambda task: task.lost))
    with one_line(r"^task: 'PointMass' object has no attribute 'lost'$"):
        own_task()


@pytest.mark.slow
def test_an_attribute_of_an_own_task_of_another_kind_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for attribute, given, line in (
        ("criteria", PointMass.criteria[0], r"a tuple of Criterion, got Criterion\(name="),
        ("inputs", (("force", "N"),), r"a tuple of Quantity, got \(\('force', 'N'\),\)$"),
        ("start_deviation", [0.5], r"numbers of the shape \(2,\), got \[0\.5\]$"),
        ("input_limit", ["8 N"], r"numbers of the shape \(1,\), got \['8 N'\]$"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(PointMass, attribute, given)
            with one_line(rf"^task: PointMass\.{attribute}: expected {line}"):
                own_task()
    monkeypatch.setattr(PointMass, attribute, given)
    with one_line(rf"^task: PointMass\.{attribute}: expected {line}"):
        expand([*POINT_MASS, "+sweep={trials: 1, axes: {}}"], OWN_CONF)
