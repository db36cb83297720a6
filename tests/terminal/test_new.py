"""`python -m simbias new`: the folder runs as it is, and goes through the conformance suite."""

import sys
from pathlib import Path

import pytest

import simbias
from simbias.__main__ import main
from simbias.core.commands import BAD_INPUT


@pytest.mark.slow
def test_a_new_robot_keeps_its_contracts_and_learns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process; `test_command_line.py` starts others."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", "arm"]) == 0
    made, folder = capsys.readouterr().out, tmp_path / "arm"
    files = {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}
    groups = ("cost", "hardware", "nominal", "preset", "task")
    assert files == {"arm.py", "test_arm.py", "README.md", *(f"conf/{group}/arm.yaml" for group in groups)}
    assert not any("my_robot" in (folder / file).read_text() for file in files)
    commands = [line.split(" -m simbias ")[1].split() for line in made.splitlines() if " -m " in line]
    assert [command[0] for command in commands] == ["check", "preview", "--config-dir"]
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    try:
        checked = main([*commands[0], "hardware=arm", "nominal=arm", "task=arm"])
        out, err = capsys.readouterr()
        assert checked == 0, out + err
        assert "hardware arm, nominal arm, task arm: all checks hold." in out
        assert "was not checked" not in out
        ran = main([*commands[2], "tracking=none"])
        out, err = capsys.readouterr()
        assert ran == 0, out + err
        assert "Succeeded after 3 hardware experiments" in out
        simbias.load(["preset=arm", "method=lqr", "tracking=none"], "conf")  # any method runs with it
    finally:
        sys.modules.pop("arm", None)


def test_a_name_that_does_not_do_is_bad_input(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "taken").touch()
    for name, message in (
        ("my robot", "new: expected the name of a Python module"),
        ("class", "new: expected the name of a Python module"),
        ("numpy", "new: a module named numpy is already installed"),
        ("taken", "taken: already exists"),
    ):
        assert main(["new", name]) == BAD_INPUT
        assert capsys.readouterr().err.startswith(f"simbias: {message}")
    for names in ([], ["a", "b"]):
        with pytest.raises(SystemExit, match=str(BAD_INPUT)):
            main(["new", *names])
    assert [path.name for path in folder.iterdir()] == ["taken"]
