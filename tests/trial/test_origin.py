import subprocess
from copy import copy
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import pytest
from texts import write

import simbias
from simbias.terminal.trial import changed_since
from simbias.trial import origin
from simbias.trial.run import run_trial
from simbias.trial.study import Study


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_commit_of_the_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(origin, "PACKAGE", tmp_path / "simbias")
    commit = origin._commit.__wrapped__
    assert commit() == {}
    git(tmp_path, "init")
    assert commit() == {}
    (tmp_path / "code.py").write_text("a = 1")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "a")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert commit() == {"commit": head, "changed": False}
    (tmp_path / "code.py").write_text("a = 2")
    assert commit() == {"commit": head, "changed": True}


@pytest.mark.slow
def test_what_comes_from_the_environment_is_written_in_clear_with_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Once; the store's address is not written at all."""
    monkeypatch.setenv("TOKEN", "s3cret")
    secrets = ["hardware.command='robot ${oc.env:TOKEN}'", "tracking.uri='${oc.env:TOKEN}'"]
    quick = ["optimizer.max_evaluations=5", "method.max_iterations=1"]
    study = simbias.load(["hardware=process", *secrets, *quick])
    for _ in range(2):
        run_trial(study, tmp_path / "trial")
    (warning,) = [each.getMessage() for each in caplog.records]
    told = "simbias: hardware.command: taken from the environment, and written in plain text to "
    assert warning.startswith(f"{told}{tmp_path}")
    assert (tmp_path / "trial" / "trial.json").read_text().count("s3cret") == 1


ROBOT = """
<mujoco>
  <compiler meshdir="shapes"/>
  <include file="parts.xml"/>
  <worldbody>
    <body><joint name="angle" type="hinge" axis="0 1 0"/><geom type="mesh" mesh="rod"/></body>
  </worldbody>
  <actuator><motor name="torque" joint="angle" ctrlrange="-2 2" ctrllimited="true"/></actuator>
</mujoco>
"""
TASK = """
_target_: simbias.robots.declared.task.Declared
time_step: 0.01
horizon: 50
states: {angle: {unit: rad, kind: angle, mean: 0.1}, rate: {unit: rad/s, kind: velocity}}
inputs: {torque: {unit: N m, limit: 1.0}}
failure: {far: {value: abs(angle), above: 1.0, unit: rad, words: too far}}
figure: {file: robot.xml}
reference: path.csv
"""
ROD = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.5\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


@pytest.mark.slow
def test_a_file_that_a_component_reads_and_that_changes_is_said(tmp_path: Path, uncompiled: None) -> None:
    """A model with its includes and meshes, a figure, recordings; a file that nobody reads is not.

    In a folder of another name, nothing has changed.
    """
    conf = tmp_path / "conf"
    files = {
        "robot.xml": ROBOT,
        "parts.xml": '<mujoco><asset><mesh name="rod" file="rod.obj"/></asset></mujoco>',
        "shapes/rod.obj": ROD,
        "path.csv": "t,angle\n0,0.0\n0.5,0.0\n",
        "policy.json": '{"parameters": [0.5, 0.0]}',
        "recordings/1.csv": "time,angle,rate,torque\n0,0.1,0,0\n1,0.1,0,0\n",
        "conf/task/mine.yaml": TASK,
        "conf/nominal/mine.yaml": "_target_: simbias.robots.mujoco.model.Mujoco\nfile: robot.xml\n",
        "notes.txt": "nobody reads this",
    }
    write(tmp_path, files)
    overrides = ["task=mine", "nominal=mine", "hardware=recorded", "cost=acrobot", "samples=thresholds"]
    overrides += ["method=model_based", f"method.first_policy={tmp_path / 'policy.json'}"]
    overrides += ["bias=none", "tracking=none", "optimizer.max_evaluations=5"]
    study = simbias.load(overrides, conf)
    run_trial(study, tmp_path / "trial")
    assert changed_since(study, tmp_path / "trial") == ""
    for name, text in files.items():
        (tmp_path / name).write_text(text.replace("0.5", "0.4") + "\n")
        said = changed_since(study, tmp_path / "trial")
        read = not name.startswith(("conf", "notes"))
        assert (f"({'/'.join((tmp_path / name).parts[-2:])})" in said) == read, name
        (tmp_path / name).write_text(text)
    moved = Path(copytree(tmp_path, tmp_path / "moved"))
    study = simbias.load(overrides, moved / "conf")
    assert changed_since(study, tmp_path / "trial") == ""
    (moved / "path.csv").write_text("t,angle\n0,0.1\n0.5,0.2\n")
    assert f"(moved/path.csv, {tmp_path.name}/path.csv)" in changed_since(study, tmp_path / "trial")


def test_files_that_a_component_reads_may_be_strings(study: Study, folder: Path) -> None:
    file = folder / "gains.csv"
    file.write_text("1,2\n")
    own = copy(study.policy)
    vars(own)["source_files"] = ["gains.csv", file]
    assert set(origin.digests(replace(study, policy=own))) == {f"{folder.name}/gains.csv"}


def test_versions_of_all_that_is_required() -> None:
    versions = origin._versions()
    assert {"python", "simbias", "mlflow", "nlopt", "mujoco", "gymnasium"} <= set(versions)
    assert not {"pytest", "sphinx"} & set(versions)


def test_a_models_digest_is_of_its_values_wherever_they_are_declared() -> None:
    """The bongoboard's are its robot's; how long an episode takes is no part of a model."""
    changes = [[], ["task.horizon=100"], ["task.robot.gravity=3.0"], ["nominal.foot_mass=0.5"]]
    digests = [origin.model_digest(simbias.load([*each, "tracking=none"])) for each in changes]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3
