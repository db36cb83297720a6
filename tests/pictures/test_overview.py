"""Figures: the drawing against the task's geometry, what figures say, and what they do without."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from simbias.core.records import Iteration, Learning, Optimum, Rollout, Search, Selection, Transitions
from simbias.pictures import drawing_of, overview, save, snapshots
from simbias.pictures.__main__ import main
from simbias.pictures.elements.drawing import NoPictureError, share_view
from simbias.pictures.elements.style import HARDWARE, SIMULATION
from simbias.robots.bongoboard.task_drawing import draw
from simbias.trial.study import Study

ORIGIN = np.zeros(6)
# a state that each criterion of the bongoboard names
FAILURES = {
    "the board touches the ground": (1.0, -0.2, 0.0, 0.0, 0.0, 0.0),
    "the board leaves the wheel": (2.8, -2.7, 0.0, 0.0, 0.0, 0.0),
    "too far from the static equilibrium": (1.3, -1.3, -0.9, 0.0, 0.0, 0.0),
    "the body leans too far": (0.1, 0.0, 1.1, 0.0, 0.0, 0.0),
    "the board leans too far": (-0.45, 1.5, -0.2, 0.0, 0.0, 0.0),
    "too fast": (0.0, 0.0, 0.0, 0.0, 40.0, 0.0),
}
BALANCING = np.array([8.118, 4.731, -6.740, -1.024, -5.560])


def centre(patch) -> np.ndarray:
    """Centre of a drawn circle or box."""
    return np.array(patch.center) if isinstance(patch, Circle) else patch.get_xy()[:4].mean(axis=0)


def texts(figure: Figure) -> str:
    """All that a figure says."""
    words = []
    for axes in figure.axes:
        legend = axes.get_legend()
        words += [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
        words += [text.get_text() for text in axes.texts + (legend.get_texts() if legend else [])]
    return "\n".join(words)


def iteration_of(study: Study, index: int, theta: np.ndarray, experiments: tuple[Rollout, ...]) -> Iteration:
    """An iteration as a method would record it."""
    data = Transitions(np.zeros((1, 7)), np.zeros((1, 6)))
    return Iteration(
        index=index,
        parameters=theta,
        experiments=tuple(replace(rollout, parameters=theta) for rollout in experiments),
        hardware_cost=max(rollout.cost for rollout in experiments),
        succeeded=all(map(study.cost.passes, experiments)),
        total_experiments=(index + 1) * len(experiments),
        search=Search(Optimum(theta, 3.0, 1000, "the test"), 3.0, study.bias.fit(study.no_data)),
        learning=Learning(Selection(data, 1, 1, {}), data),
    )


@pytest.fixture(scope="module")
def fallen(study: Study) -> Rollout:
    return study.simulate(np.zeros(5))


@pytest.fixture(scope="module")
def balanced(study: Study) -> Rollout:
    rollout = study.simulate(BALANCING)
    assert rollout.failed_at is None
    return rollout


@pytest.fixture(scope="module")
def trial(study: Study, fallen: Rollout, balanced: Rollout) -> list[Iteration]:
    """A trial whose first policy falls and whose last balances, with simulation in place of the hardware."""
    return [
        iteration_of(study, 0, np.zeros(5), (fallen, balanced)),
        iteration_of(study, 1, BALANCING, (balanced, balanced)),
    ]


@pytest.mark.parametrize("seed", range(5))
def test_drawing_agrees_with_the_pose(study: Study, seed: int) -> None:
    """Every part is where the task's geometry has it, to scale."""
    robot, state = study.task.robot, np.random.default_rng(seed).normal(0.0, 0.4, 6)
    pose, artists = study.task.pose(state[:3]), draw(Figure().subplots(), study.task, state)
    np.testing.assert_allclose(centre(artists["wheel"]), pose.wheel)
    np.testing.assert_allclose(centre(artists["board"]), pose.board)
    for joint, place in {"ankle": pose.ankles, "hip": pose.pelvis}.items():
        left, right = (centre(artists[f"{side} {joint}"]) for side in ("left", "right"))
        np.testing.assert_allclose((left + right) / 2, place, atol=1e-12)
        np.testing.assert_allclose(
            right - left, robot.ankle_spacing * direction(pose.board_angle), atol=1e-12
        )
    for side in ("left", "right"):
        leg = centre(artists[f"{side} hip"]) - centre(artists[f"{side} ankle"])
        np.testing.assert_allclose(leg, robot.leg_length * direction(pose.leg_angle + np.pi / 2), atol=1e-12)
        np.testing.assert_allclose(centre(artists[f"{side} leg"]), centre(artists[f"{side} ankle"]) + leg / 2)
    corners = artists["board"].get_xy()
    np.testing.assert_allclose(
        corners[1] - corners[0], robot.board_length * direction(pose.board_angle), atol=1e-12
    )


def direction(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def test_foot_stands_between_board_and_ankles(study: Study) -> None:
    """At rest: the board on the wheel, the foot on the board, the ankles at the foot's upper side."""
    robot, artists = study.task.robot, draw(Figure().subplots(), study.task, ORIGIN)
    heights = {name: artists[name].get_xy()[:, 1] for name in ("board", "foot")}
    assert heights["board"].min() == pytest.approx(2 * robot.wheel_radius)
    assert heights["foot"].min() == pytest.approx(heights["board"].max())
    assert heights["foot"].max() == pytest.approx(centre(artists["left ankle"])[1])


def test_sector_turns_with_the_wheel(study: Study) -> None:
    """A wheel that has rolled to the left has turned counter-clockwise."""
    artists = draw(Figure().subplots(), study.task, np.array([np.pi / 2, -np.pi / 2, 0, 0, 0, 0]))
    hub, rim = artists["sector"].get_xy()[0], artists["sector"].get_xy()[5]
    assert hub[0] == pytest.approx(-study.task.robot.wheel_radius * np.pi / 2)
    np.testing.assert_allclose(rim - hub, [-study.task.robot.wheel_radius, 0.0], atol=1e-12)


def test_failures_are_all_there_are(study: Study) -> None:
    assert {criterion.words for criterion in study.task.criteria} == set(FAILURES)


@pytest.mark.parametrize("words", FAILURES)
def test_every_failure_can_be_shown(study: Study, words: str) -> None:
    """A failed rollout is pale at its failing frame, with time and words; nothing is drawn after it."""
    task, state = study.task, np.array(FAILURES[words])
    name = task.failure(state)
    assert task.words(name) == words
    rollout = Rollout(np.array([ORIGIN, state]), np.zeros((1, 1)), 1, name)
    figure = snapshots(task, {"hardware": rollout}, [0.0, 0.001, 0.002])
    before, failing, after = figure.axes
    assert {patch.get_alpha() for patch in before.patches} == {1.0}
    assert all(patch.get_alpha() < 1.0 for patch in failing.patches)
    assert f"0.00 s: {words}" in texts(figure).replace("\n", " ")
    np.testing.assert_allclose(failing.patches[0].center, task.pose(state[:3]).wheel)
    assert not after.has_data()


@pytest.mark.slow
def test_snapshots_have_one_scale_and_show_all(study: Study, fallen: Rollout, balanced: Rollout) -> None:
    figure = snapshots(study.task, {"nominal model": fallen, "hardware": balanced}, [0.0, 1.5, 5.0])
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}) == 1
    (left, right), (bottom, top) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        if axes.has_data():
            assert left < axes.dataLim.x0 < axes.dataLim.x1 < right
            assert bottom < axes.dataLim.y0 < axes.dataLim.y1 < top
    for words in ("t = 1.5 s", "nominal model", "hardware", f"{fallen.failed_at / 1000:.2f} s:"):
        assert words in texts(figure)


def test_snapshot_is_of_its_time(study: Study, balanced: Rollout) -> None:
    figure = snapshots(study.task, {"hardware": balanced}, [0.0, 2.5])
    wheel = figure.axes[1].patches[0]
    np.testing.assert_allclose(wheel.center, study.task.pose(balanced.states[2500][:3]).wheel)


def test_overview_tells_what_happened(study: Study, trial: list[Iteration]) -> None:
    """The worst experiments in words, every axis with its unit, the criterion that failed."""
    fallen, words = trial[0].experiments[0], texts(overview(study, trial))
    for sentence in (
        f"Policy from simulation alone: fails on hardware after {fallen.failed_at / 1000:.2f} s",
        "Policy after 2 hardware experiments: lasts all 5 s on hardware",
        "simulation: nominal model + learned bias (gp)",
        "hardware: pymunk, worst of 2",
        study.task.words(fallen.failure),
        "time (s)",
        "cost Z (dimensionless)",
        "hardware experiment",
    ):
        assert sentence in words
    criterion = next(c for c in study.task.criteria if c.name == fallen.failure)
    assert words.count(f"{criterion.name.replace('_', ' ')} ({criterion.unit})") == 2


def test_overview_shows_the_data(study: Study, trial: list[Iteration]) -> None:
    """Its lines are the measures and costs of the records; colours tell simulation and hardware apart."""
    fallen = trial[0].experiments[0]
    index = next(i for i, c in enumerate(study.task.criteria) if c.name == fallen.failure)
    panels = [axes for axes in overview(study, trial).axes if axes.get_legend() is not None]
    hardware = next(line for line in panels[0].lines if line.get_label().startswith("hardware"))
    times, measures = hardware.get_data()
    np.testing.assert_allclose(times, 0.001 * np.arange(fallen.frames + 1))
    np.testing.assert_allclose(measures, [study.task.measure(x)[index] for x in fallen.states])
    costs = [line for line in panels[-1].lines if line.get_marker() == "o"]
    points = np.concatenate([line.get_data() for line in costs], axis=1)
    np.testing.assert_array_equal(points[0], [1, 2, 3, 4])
    np.testing.assert_array_equal(points[1], [r.cost for i in trial for r in i.experiments])
    assert {to_hex(line.get_color()).upper() for line in costs} == {HARDWARE}
    assert HARDWARE != SIMULATION


def test_snapshots_stand_above_their_times(study: Study, trial: list[Iteration]) -> None:
    figure = overview(study, trial)
    panel = next(axes for axes in figure.axes if axes.get_xlabel() == "time (s)")
    pictures = [axes for axes in figure.axes if axes.get_aspect() == 1.0][:6]
    ticks = panel.get_xticks()
    at = panel.transData.transform(np.column_stack([ticks, ticks]))[:, 0] / figure.bbox.width
    middles = [axes.get_position(original=True) for axes in pictures]
    np.testing.assert_allclose([(box.x0 + box.x1) / 2 for box in middles], at)


def test_a_trial_of_one_iteration(study: Study, trial: list[Iteration]) -> None:
    words = texts(overview(study, trial[:1]))
    assert "simulation alone" in words
    assert "learned bias" not in words


def test_a_failure_that_no_criterion_names(study: Study, trial: list[Iteration]) -> None:
    """Hardware has failures of its own."""
    fallen = replace(trial[0].experiments[0], failure="the_physics_engine_blew_up")
    figure = overview(study, [replace(trial[0], experiments=(fallen,))])
    assert "the physics engine blew up" in texts(figure)


def test_a_method_without_search(study: Study, trial: list[Iteration]) -> None:
    """Hardware alone, and the policy that each iteration arrived at, of those that it tried."""
    first, last = (replace(iteration, search=None, learning=None) for iteration in trial)
    first = replace(first, parameters=BALANCING, experiments=first.experiments + last.experiments)
    words = texts(overview(study, [first, replace(last, index=1)]))
    assert "Policy of iteration 0: lasts all 5 s on hardware" in words
    assert "Policy of iteration 1: lasts all 5 s on hardware" in words
    assert "hardware: pymunk, worst of 2" in words
    assert "simulation" not in words
    assert "predicted" not in words


def test_a_trial_that_tried_no_policy(study: Study, trial: list[Iteration]) -> None:
    with pytest.raises(NoPictureError, match="no policy was tried"):
        overview(study, [replace(trial[0], experiments=())])


def test_a_policy_that_is_too_costly(study: Study, trial: list[Iteration]) -> None:
    """No failure is no success yet (line 10 of Algorithm 1)."""
    costly = replace(trial[1].experiments[0], cost=345.6, parameters=trial[0].parameters)
    words = texts(overview(study, [replace(trial[0], experiments=(costly,))]))
    assert "too costly on hardware (Z = 346)" in words


@pytest.mark.slow
def test_same_figure_gives_the_same_file(study: Study, trial: list[Iteration], tmp_path: Path) -> None:
    """And at twice a README's width, in few bytes, in true colours."""
    for name in ("one.png", "two.png"):
        save(overview(study, trial), tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert (tmp_path / "one.png").stat().st_size < 200_000
    picture = Image.open(tmp_path / "one.png").convert("RGB")
    assert picture.width == 1800
    colours = {colour for _, colour in picture.getcolors()}
    for colour in (HARDWARE, SIMULATION, "#FFFFFF"):
        assert (
            min(np.abs(np.array(c) - [int(colour[i : i + 2], 16) for i in (1, 3, 5)]).max() for c in colours)
            < 4
        )


@pytest.mark.slow
def test_figures_leave_pyplot_alone() -> None:
    """In a process that draws, pyplot is never imported: no display is needed, no figure stays open."""
    program = (
        "import sys; import numpy as np; import simbias; from simbias.pictures import snapshots\n"
        "from simbias.core.records import Rollout\n"
        "rollout = Rollout(np.zeros((2, 6)), np.zeros((1, 1)))\n"
        "snapshots(simbias.load().task, {'a': rollout}, [0.0])\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.slow
def test_a_task_without_a_drawing(point_mass: Study, tmp_path: Path) -> None:
    """Everything but snapshots works for any task."""
    iterations = list(point_mass.run())
    assert drawing_of(point_mass.task) is None
    figure = overview(point_mass, iterations)
    assert "distance (m)" in texts(figure)
    save(figure, tmp_path / "point_mass.png")
    with pytest.raises(LookupError, match="nothing draws PointMass"):
        snapshots(point_mass.task, {"hardware": iterations[0].experiments[0]}, [0.0])


@pytest.mark.slow
def test_a_drawing_of_ones_own(point_mass: Study) -> None:
    def draw_mass(axes, task, state, *, color="0.4", muted=False):
        return {"mass": axes.add_patch(Circle((state[0], 0.0), 0.05, color=color))}

    rollout = point_mass.simulate(np.array([1.0, 1.0, 0.0]))
    assert len(snapshots(point_mass.task, {"simulation": rollout}, [0.0, 1.0], draw_mass).axes) == 2
    figure = overview(point_mass, list(point_mass.run()), draw_mass)
    assert sum(len(axes.patches) > 0 and axes.get_aspect() == 1.0 for axes in figure.axes) == 12


def test_no_drawings_need_no_view() -> None:
    share_view([])


@pytest.mark.slow
def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out.png")
    few = ["optimizer.max_evaluations=150", "--config-dir", str(OWN_CONF)]
    assert main([out, *POINT_MASS, *few]) == 0
    assert Image.open(out).format == "PNG"
    assert "seed 0" in capsys.readouterr().out
    assert main([out, "bias=unknown"]) == 2
    assert capsys.readouterr().err.startswith("simbias: ")
    for bad in ("seed=3", str(tmp_path / "missing" / "out.png")):
        with pytest.raises(SystemExit, match="2"):
            main([bad])
