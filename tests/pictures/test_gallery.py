"""All pictures of a trial as files; what it cannot have is left out, and no picture is worth a trial."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from simbias.core.records import Iteration
from simbias.pictures import save_animation
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.style import HARDWARE, SIMULATION
from simbias.pictures.trial.comparison import simulated, worst_experiment
from simbias.pictures.trial.gallery import ANIMATION, FIGURES, illustrate, pictures
from simbias.trial.folder import Withdrawal
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary

pytestmark = pytest.mark.slow

AT_REST = [name for name in FIGURES if name != "following"]  # of a task whose goal does not move


def test_the_worst_experiment_is_one_that_missed_the_goal(trial: list[Iteration]) -> None:
    """Whatever it cost; of several, the most costly one."""
    costs = {1.0: True, 0.5: False, 0.2: False}
    tried = [replace(trial[0].experiments[0], cost=cost) for cost in costs]
    study = cast(Study, SimpleNamespace(passes=lambda rollout: costs[rollout.cost]))
    assert worst_experiment(study, replace(trial[0], experiments=tuple(tried))).cost == 0.5


def test_all_pictures_of_a_trial(short: Study, trial: list[Iteration]) -> None:
    """The animation is in real time and shows all."""
    files = pictures(short, trial)
    assert list(files) == [*(f"{name}.png" for name in AT_REST), "animation.gif"]
    for name, content in files.items():
        assert Image.open(BytesIO(content)).format == name.rpartition(".")[2].upper()
    assert sum(map(len, files.values())) < 1_000_000
    picture, durations, sizes = Image.open(BytesIO(files["animation.gif"])), [], set()
    for frame in range(picture.n_frames):
        picture.seek(frame)
        durations.append(picture.info["duration"])
        sizes.add(picture.size)
    worst = worst_experiment(short, trial[-1])
    rollouts = [worst, *simulated(short, trial[-1], [worst])]
    longest = max(rollout.frames for rollout in rollouts) * short.task.time_step
    assert sum(durations[:-1]) == pytest.approx(1000 * longest, abs=100)
    assert len(sizes) == 1
    assert len(picture.convert("RGB").getcolors()) > 10
    assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
    shown = Image.open(BytesIO(files["overview.png"])).convert("RGB")
    colours = np.array([colour for _, colour in shown.getcolors()])
    for name in (HARDWARE, SIMULATION, "#FFFFFF"):
        wanted = np.array([int(name[i : i + 2], 16) for i in (1, 3, 5)])
        assert np.abs(colours - wanted).max(axis=1).min() < 4


def test_a_trial_has_pictures_of_what_it_has(
    short: Study,
    trial: list[Iteration],
    on_hardware: list[Iteration],
    of_point_mass: tuple[Study, list[Iteration]],
    recwarn: pytest.WarningsRecorder,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without search, those of the hardware; without experiments, its costs alone.

    What is withdrawn is marked. A task that nothing draws has no animation.
    """
    assert pictures(short, on_hardware, ["costs", "rejections", "phases"]).keys() == {"phases.png"}
    assert pictures(short, [replace(trial[0], experiments=(), learning=None)]).keys() == {"costs.png"}
    assert pictures(short, []) == {}
    assert not recwarn.list
    loose = Withdrawal("0004_experiment.npz", "a loose cable", (), 0.0, 0.0)
    monkeypatch.setattr("simbias.pictures.trial.gallery.png", Figure.get_supxlabel)
    assert pictures(*of_point_mass, ["costs", ANIMATION]) == {"costs.png": ""}
    assert pictures(*of_point_mass, ["costs"], [loose]) == {"costs.png": str(loose)}
    with pytest.raises(NoPictureError, match="PointMass"):
        save_animation(*of_point_mass, BytesIO())


def test_what_a_full_disk_left_half_written_is_drawn_again(
    of_point_mass: tuple[Study, list[Iteration]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(FIGURES, "costs", lambda *_: Figure())
    study, iterations = of_point_mass
    record = TrialRecord(study, TrialSummary(Outcome.SUCCEEDED), tuple(iterations))
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "costs.png.part").touch()
    for _ in range(2):  # the second time all is there
        illustrate(record, tmp_path, ["costs"])
    assert [file.name for file in tmp_path.glob("pictures/*")] == ["costs.png"]
    (tmp_path / "empty").mkdir()
    illustrate(replace(record, iterations=()), tmp_path / "empty")
    assert (tmp_path / "empty" / "pictures" / "none.txt").read_text().startswith("This trial has nothing")
