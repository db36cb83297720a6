"""What README shows works, from a folder that is not the checkout; what it links to is there."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from conftest import OWN_CONF, ROOT

from simbias.__main__ import main

README = (ROOT / "README.md").read_text()
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(
        ROOT / folder / "README.md"
        for folder in ("conf", "simbias", "simbias/engine", "simbias/robots", "tests", "sweeps/results")
    ),
]
SHORT = [
    "task.horizon=200",
    "optimizer.max_evaluations=20",
    "method.max_iterations=1",
    "tracking.pictures=false",
]
SHOWN = README + (ROOT / "simbias" / "robots" / "README.md").read_text()
COMMANDS = sorted(
    {
        line.partition("  #")[0].strip()
        for block in re.findall(r"^```sh\n(.*?)^```", SHOWN, re.MULTILINE | re.DOTALL)
        for line in block.splitlines()
        if line.startswith("python ")
    }
)


def shortened(command: str) -> list[str]:
    """The command's arguments, so that it is soon done; Arm is a robot that readers write themselves."""
    arguments = shlex.split(command)[1:]
    if {"--help", "new"} & set(arguments):
        return arguments
    own = {
        "hardware=arm": "hardware=point_mass",
        "my_conf": str(OWN_CONF),
        "hardware.port=/dev/arm1": "seed=1",
    }
    arguments = [own.get(word, word) for word in arguments]
    if str(OWN_CONF) in arguments:
        groups = sorted(folder.name for folder in OWN_CONF.iterdir() if folder.is_dir())
        return [*arguments, *(f"{group}=point_mass" for group in groups), "method.max_iterations=1"]
    trials = ["sweep.trials=1", "sweep.axes.noise.values=[[0.0,0.0,0.0]]", "engine=sequential"]
    return [*arguments, *SHORT, *(trials if "+sweep=table2" in arguments else [])]


def test_readme_has_commands() -> None:
    assert len(COMMANDS) >= 8


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_runs(
    command: str,
    new_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In this process, as a new one takes seconds; `tests/terminal/test_command_line.py` starts some."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(new_store, tmp_path)
    module, name, *arguments = shortened(command)
    assert (module, name) == ("-m", "simbias")
    if not {"--help", "new", "check", "tracking=folders"} & set(arguments):
        arguments.append(
            f"tracking.uri=sqlite:///{tmp_path}/mlflow.db"
        )  # MLflow keeps what a relative one meant
    try:
        status = main(arguments)
    except SystemExit as end:  # of --help
        status = int(end.code or 0)
    out, err = capsys.readouterr()
    assert status in (0, 1, 3), err  # 1: so short a trial need not succeed; 3: it waits
    assert "Traceback" not in err
    assert out


def test_the_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (block, *_) = re.findall(r"^```python\n(import simbias.*?)^```", README, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    quick = block.replace('"seed=3"', ", ".join(f'"{word}"' for word in ("seed=3", *SHORT[:3])))
    assert quick != block
    exec(compile(quick, "README.md", "exec"), {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+?)\)", page.read_text())
    assert [target for target in targets if "://" not in target and not (page.parent / target).exists()] == []


def test_the_trial_that_readme_shows_is_todays() -> None:
    import simbias

    assert f"seed 0, trial {simbias.load(['tracking=none']).hash}" in README
