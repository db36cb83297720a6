"""A config names only classes of simbias, of modules beside its folder, and of those that the user allows."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS
from texts import write

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError, compose
from simbias.config.allowed import NOTHING
from simbias.config.build import build
from simbias.sweep.grid import expand
from simbias.sweep.worker import PlannedTrial, run_plan

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("uncompiled")]

CLASS = """
from pathlib import Path
from simbias.learning.bias.none import NoBias

Path("imported").touch()

class Mine(NoBias): ...
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with configs, a module and a package beside them, and a module deeper in an environment."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for name in ("", ".venv", "conf"):
        monkeypatch.syspath_prepend(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    files = {
        "beside.py": CLASS,
        "package/part.py": CLASS,
        "conf/inside.py": CLASS,
        ".venv/installed.py": CLASS,
        "conf/bias/beside.yaml": "_target_: beside.Mine",
        "conf/bias/part.yaml": "_target_: package.part.Mine",
        "conf/bias/inside.yaml": "_target_: inside.Mine",
        "conf/bias/installed.yaml": "_target_: installed.Mine",
    }
    yield write(tmp_path, files)
    for name in ("beside", "package", "package.part", "inside", "installed"):
        sys.modules.pop(name, None)


def bias_of(option: str) -> str:
    """The class of the bias that is loaded."""
    return type(simbias.load([f"bias={option}", "tracking=none"], "conf").bias).__name__


def test_what_lies_beside_or_in_a_named_folder_or_is_in_its_list(project: Path) -> None:
    """An axis may name it, too."""
    assert {bias_of(option) for option in ("beside", "part", "inside")} == {"Mine"}
    assert (project / "imported").exists()
    sweep = expand(["+sweep={trials: 1, axes: {bias: [none, beside, part]}}"], "conf")
    assert [cell.composition.own.modules for cell in sweep.cells] == [(), ("beside",), ("package",)]
    (project / "conf" / "components.yaml").write_text("allow: [installed]")
    assert bias_of("installed") == "Mine"


def test_what_lies_beside_a_folder_is_found_from_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, {"lab/apart.py": CLASS, "lab/conf/bias/apart.yaml": "_target_: apart.Mine"})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    loaded = simbias.load(["bias=apart", "tracking=none"], "lab/conf")
    assert (type(loaded.bias).__name__, loaded.composition.own.modules) == ("Mine", ("apart",))
    sys.modules.pop("apart", None)


def test_a_module_that_hides_one_beside_a_folder_is_refused(project: Path) -> None:
    """Also if it is allowed, or already imported."""
    names = {"beside": "beside.py", "package.part": "package/part.py"}
    other = write(project / "other", dict.fromkeys(names.values(), CLASS.replace("...", "pass")))
    write(other, {f"conf/bias/{name}.yaml": f"_target_: {name}.Mine" for name in names})
    assert bias_of("beside") == "Mine"
    for name, file in names.items():
        line = rf"^{other / file}: Python imports '{name}' from {project / file} instead; rename one of them$"
        for allow in ([], [name]):
            with pytest.raises(ConfigError, match=line):
                compose([f"bias={name}"], other / "conf", allow)


def test_copies_of_a_module_hide_nothing(project: Path) -> None:
    """Such as an installed package beside its source, or simbias beside another checkout of it."""
    copied = CLASS.replace("\n", "\r\n")  # as Git writes it on Windows
    other = write(project / "other", {"beside.py": copied, "conf/bias/mine.yaml": "_target_: beside.Mine"})
    write(other, {"simbias/__init__.py": "", "simbias/cost/quadratic.py": "", "simbias/cost/__init__.py": ""})
    assert compose(["bias=mine", "preset=double_cartpole"], other / "conf", ["beside"])


def test_what_is_not_allowed_is_not_imported(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = "sweep: {trials: 1, axes: {}, figures: {one: {_target_: installed.Mine}}}"
    write(project, {"conf/sweeps/mine.yaml": sweep})
    for overrides, module in (
        (["bias=installed"], "installed"),
        (["bias=none", "bias._target_=os.system"], "os"),
        (["bias=none", "bias._target_=simbias_.Mine"], "simbias_"),
        (["tracking._target_=antigravity.Mine"], "antigravity"),
        (["engine._target_=installed.Mine"], "installed"),
        (["+sweep=mine"], "installed"),
    ):
        assert main(["--config-dir", "conf", "tracking=none", *overrides]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"--allow {module}" in line
        assert not (project / "imported").exists()
        assert module == "os" or module not in sys.modules
    with pytest.raises(
        ConfigError, match=r"bias\._target_: 'beside' is not imported: .*by --config-dir or, .*--allow beside"
    ):
        build(compose(["bias=none", "bias._target_=beside.Mine", "tracking=none"]))  # of no one's folder


def test_a_prefix_is_allowed_by_a_flag(project: Path) -> None:
    overrides = ["bias=none", "bias._target_=package.part.Mine", "tracking=none"]
    for prefix in ("package", "package.part"):
        assert simbias.load(overrides, allow=["other", prefix])
    with pytest.raises(ConfigError, match="--allow package"):
        simbias.load(overrides, allow=["pack", "package.par", "package.part.Mine"])


def test_a_bad_file_is_named(project: Path) -> None:
    for text in ("allow: mine", "[mine]", "allow: [3]", "allow: ['a b']", "a: [", "allow: []\nb: 1"):
        (project / "conf" / "components.yaml").write_text(text)
        with pytest.raises(ConfigError, match=r"^conf/components\.yaml"):
            compose([], "conf")
    with pytest.raises(ConfigError, match=r"^--allow: must be the name of a module"):
        compose([], allow=["../x"])


def test_workers_are_told(project: Path) -> None:
    short = ["task.horizon=20", "optimizer.max_evaluations=2", "method.max_iterations=1", "tracking=none"]
    trial = compose(["bias=beside", *short], "conf").trial
    assert trial.own == (("beside",), (str(project / "conf"),))
    assert run_plan(PlannedTrial(trial)).summary.outcome.final
    assert "--allow beside" in run_plan(PlannedTrial(replace(trial, own=NOTHING))).summary.reason


def test_what_is_allowed_is_no_part_of_a_trials_identity() -> None:
    one, other = (compose([*POINT_MASS], OWN_CONF, allow) for allow in ([], ["elsewhere"]))
    assert one == other
    assert one.hash == other.hash
    assert one.trial.own.modules == ("point_mass",)
    assert other.own.modules == ("elsewhere", "point_mass")


def test_an_own_dataclass_may_extend_a_shipped_one(project: Path) -> None:
    """Annotations of inherited fields name what only the shipped module imports."""
    own = ("from dataclasses import dataclass", "from simbias.trial.methods.algorithm1 import Algorithm1")
    text = "\n".join([*own, "@dataclass(eq=False)", "class Mine(Algorithm1):", "    more: float = 1.0"])
    (project / "mine.py").write_text(f"from __future__ import annotations\n{text}\n")
    values = ["method._target_=mine.Mine", "+method.more=2", "method.max_iterations=3", "tracking=none"]
    method = simbias.load(values, project / "conf", allow=["mine"]).method
    assert (type(method).__name__, method.more, method.max_iterations) == ("Mine", 2.0, 3)  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"^method\.more: .*got 'much'"):
        simbias.load([*values, "method.more=much"], project / "conf", allow=["mine"])


def test_annotations_that_are_no_parameters_may_be_for_type_checkers(project: Path) -> None:
    """As of attributes, or of a dataclass' fields that its constructor does not take."""
    own = ("from __future__ import annotations", "from dataclasses import dataclass, field")
    plain = ("from simbias.learning.bias.none import NoBias", "class Plain(NoBias):", "    kept: Unknown")
    fields = (
        "@dataclass",
        "class Fields(Plain):",
        "    more: float = 1.0",
        "    other: Unknown = field(init=False)",
    )
    (project / "hints.py").write_text("\n".join([*own, *plain, *fields]))
    for name, more in (("Plain", []), ("Fields", ["+bias.more=2"])):
        values = ["bias=none", f"bias._target_=hints.{name}", *more, "tracking=none"]
        assert type(simbias.load(values, project / "conf", allow=["hints"]).bias).__name__ == name


EXITS = "raise SystemExit(7)"
CANCELLED = "import asyncio\nraise asyncio.CancelledError('late')"
CONSTRUCTOR = CLASS.replace(" ...", "\n    def __init__(self{}) -> None: {}")
UNKNOWN = CONSTRUCTOR.format(", size: 'Unknown' = 3", "pass")


def test_a_module_that_raises_is_one_line(project: Path) -> None:
    for text, line in (
        ("1 / 0", r"cannot import 'beside\.Mine' \(ZeroDivisionError: division by zero\)$"),
        (EXITS, r"cannot import 'beside\.Mine' \(SystemExit: 7\)$"),
        (CANCELLED, r"cannot import 'beside\.Mine' \(CancelledError: late\)$"),
        (CONSTRUCTOR.format("", EXITS), r"7$"),
        (CONSTRUCTOR.format("", CANCELLED.replace("\n", "; ")), r"late$"),
        ("from simbias.core import Bias\nclass Mine(Bias): ...", r"Can't instantiate abstract class Mine"),
        (UNKNOWN, r"the annotations of Mine's constructor cannot be read \(NameError: name 'Unknown' "),
        (CONSTRUCTOR.format(", **more", "pass"), r"Mine's constructor takes \*\*more; it must name its"),
    ):
        (project / "beside.py").write_text(text)
        sys.modules.pop("beside", None)
        with pytest.raises(ConfigError, match=rf"^bias(\._target_)?: {line}"):
            bias_of("beside")
