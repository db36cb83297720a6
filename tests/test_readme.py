"""What README shows works, from the wheel in an empty folder; what it links to is there."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from conftest import OWN_CONF, ROOT
from hatchling.builders.wheel import WheelBuilder
from pendulum import COLUMNS

from simbias.core.cache import cache_folder

LARGEST_WHEEL = 1_000_000  # bytes; published pictures alone take twice as much
README = (ROOT / "README.md").read_text()
USED = ("simbias/robots", "simbias/recordings", "simbias/lab")  # whose commands are run, too
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(
        ROOT / folder / "README.md"
        for folder in ("conf", "simbias", "simbias/engine", "simbias/trial", *USED, "tests", "sweeps/results")
    ),
]
SHORT = [
    "task.horizon=120",  # swing-ups hold for 100 frames
    "optimizer.max_evaluations=20",
    "method.max_iterations=1",
    "tracking.pictures=false",
]
FOLDERS = "tracking=folders"  # in all but the first command, as MLflow takes its time
SHOWN = README + "".join((ROOT / folder / "README.md").read_text() for folder in USED)
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
    module, name, *arguments = shlex.split(command)[1:]
    assert (module, name) == ("-m", "simbias")
    if {"--help", "new", "controller"} & set(arguments):
        return ["TRIAL" if word.startswith("trials/") else word for word in arguments]
    own = {
        "hardware=arm": "hardware=point_mass",
        "my_conf": str(OWN_CONF),
        "hardware.port=/dev/arm1": "seed=1",
        "evaluation.seconds=5": "evaluation.seconds=0.1",
        "RECORDINGS": str(ROOT / "tests" / "recordings"),
    }
    arguments = [own.get(word, word) for word in arguments]
    if str(OWN_CONF) in arguments:
        groups = sorted(folder.name for folder in OWN_CONF.iterdir() if folder.is_dir())
        few = [] if "check" in arguments else ["optimizer.max_evaluations=5", *SHORT[2:]]
        return [*arguments, *(f"{group}=point_mass" for group in groups), *few, FOLDERS]
    if {"identify", "excite"} & set(arguments):
        return [
            *arguments,
            f"hardware.columns={{{COLUMNS}}}",
            *("identification.starts=2", "identification.rounds=1", "identification.evaluations=2"),
            *(["--seconds", "0.5"] if "excite" in arguments else []),
        ]
    trials = ["sweep.trials=1", "sweep.axes.noise.values=[[0.0,0.0,0.0]]", "engine=sequential"]
    trials += ["+sweep.figures={}"]
    if any(word.startswith("preset=") for word in arguments):
        return [*arguments, *SHORT[3:], FOLDERS]
    stored = [FOLDERS] if arguments else []
    return [*arguments, *SHORT, *stored, *(trials if "+sweep=table2" in arguments else [])]


PROGRAM = """
import ast, re, sys
from dataclasses import replace
from pathlib import Path
import pytest
import simbias
from in_numpy import predict_in_numpy, simulate_in_numpy
from shipped import file_of, shortened
from simbias.config import Variations
from simbias.search.optimizer import ilqr
from simbias.__main__ import main
from simbias.recordings import excitation, files
from simbias.sweep.grid import expand
from simbias.terminal import excite, identify

print("home", simbias.__file__)
figure = expand(["+sweep=fig7"]).figures["fig7"]  # whose class lies beside the sweeps
assert "/simbias/sweeps/figures/" in sys.modules[type(figure).__module__].__file__
files.report = lambda *_: ""  # drawn in test_identify.py
excite.TRAJECTORIES = identify.TRAJECTORIES = excitation.REFERENCES = 1
excitation.MODELS, excitation.REFERENCE = 2, 0.5
composed = Variations.composition

def soon_done(variations, *arguments):
    whole = composed(variations, *arguments)
    if whole.choices["nominal"] != "none":  # else a bias is all that there is
        learns = {group: file_of(group, "none") for group in ("identification", "bias")}
        whole = replace(whole, config=whole.config | learns)
    return shortened(whole)

for arguments in ast.literal_eval(sys.argv[1]):
    if "TRIAL" in arguments:  # of a command before
        made = (file for file in Path("trials").glob("*/trial.json") if "point_mass" not in file.read_text())
        arguments[arguments.index("TRIAL")] = str(next(made).parent)
    with pytest.MonkeyPatch.context() as patch:
        words = " ".join(arguments)
        if re.search("preset=|--config-dir", words) and "identify" not in words:
            # To compile a loop for each takes seconds.
            simulate_in_numpy(patch)
            patch.setattr(ilqr, "ITERATIONS", 1)
            predict_in_numpy(patch)
            if "excite" not in words:
                patch.setattr(Variations, "composition", soon_done)
        try:
            status = main(arguments)
        except SystemExit as end:  # of --help
            status = end.code
    print("status", status, flush=True)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, as it is published."""
    folder = str(tmp_path_factory.mktemp("wheel"))
    return Path(next(WheelBuilder(str(ROOT)).build(directory=folder, versions=["standard"])))


@pytest.mark.slow
def test_the_wheel_carries_what_commands_read_and_no_pictures(wheel: Path) -> None:
    assert wheel.stat().st_size < LARGEST_WHEEL
    names = set(zipfile.ZipFile(wheel).namelist())
    read = [*ROOT.glob("conf/**/*.yaml"), *ROOT.glob("sweeps/*.yaml"), *ROOT.glob("sweeps/figures/*.py")]
    sweeps = {file.stem for file in ROOT.glob("sweeps/*.yaml")}
    read += [file for file in ROOT.glob("sweeps/results/*/trials.csv") if file.parent.name in sweeps]
    assert len(read) > 100
    assert {f"simbias/{file.relative_to(ROOT).as_posix()}" for file in read} <= names
    assert {Path(name).suffix for name in names if name.startswith("simbias/")} == {
        *(".csv", ".md", ".py", ".typed", ".xml", ".yaml"),
    }
    assert not [name for name in names if name.startswith("simbias/sweeps/studies")]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment whose simbias is the wheel's; what other tests compiled is there."""
    target = tmp_path_factory.mktemp("installed")
    zipfile.ZipFile(wheel).extractall(target)
    (target / "simbias" / "__pycache__").mkdir(exist_ok=True)
    (target / "simbias" / "__pycache__" / "closed_loops").symlink_to(cache_folder("closed_loops"))
    path = os.pathsep.join(map(str, (target, OWN_CONF.parent, ROOT / "tests" / "support")))
    return os.environ | {"PYTHONPATH": path}


@pytest.mark.slow
def test_commands_run(installed: dict[str, str], new_store: Path, tmp_path: Path) -> None:
    """One after the other in one process, as a new one takes seconds: `test_command_line.py` starts some."""
    shutil.copy(new_store, tmp_path)
    wanted = [shortened(command) for command in COMMANDS]
    assert len(wanted) >= 8
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, repr(wanted)],
        cwd=tmp_path,
        env=installed,
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"home {installed['PYTHONPATH'].partition(os.pathsep)[0]}" in done.stdout
    statuses = re.findall(r"^status (\d)$", done.stdout, re.MULTILINE)
    assert len(statuses) == len(wanted)
    assert set(statuses) <= {"0", "1", "3"}, done.stderr  # a trial may fail, or wait
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_python_runs(folder: Path) -> None:
    (block, *_) = re.findall(r"^```python\n(import simbias.*?)^```", README, re.MULTILINE | re.DOTALL)
    quick = block.replace('"seed=3"', ", ".join(f'"{word}"' for word in ("seed=3", *SHORT[:3])))
    assert quick != block
    exec(compile(quick, "README.md", "exec"), {})
    assert not list(folder.iterdir())


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        targets = re.findall(r"\]\(([^)#]+?)\)", page.read_text())
        files = [target for target in targets if "://" not in target]
        assert [target for target in files if not (page.parent / target).exists()] == [], page


def test_the_trial_that_readme_shows_is_todays() -> None:
    import simbias

    assert f"seed 0, trial {simbias.load(['tracking=none']).hash}" in README
