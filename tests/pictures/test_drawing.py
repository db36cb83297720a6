"""The drawing of a task against its geometry, in snapshots too."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from simbias.core.records import Rollout
from simbias.pictures import drawing_of, snapshots
from simbias.pictures.elements.drawing import NoPictureError, share_view
from simbias.pictures.elements.style import png
from simbias.robots.bongoboard.task_drawing import draw, move
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


@pytest.fixture(scope="module")
def fallen(study: Study) -> Rollout:
    return study.simulate(np.zeros(5))


@pytest.fixture(scope="module")
def balanced(study: Study) -> Rollout:
    rollout = study.simulate(BALANCING)
    assert rollout.failed_at is None
    return rollout


@pytest.mark.parametrize("seed", range(3))
def test_moving_is_drawing_anew(short: Study, seed: int) -> None:
    state = np.random.default_rng(seed).normal(0.0, 0.4, 6)
    moving, still = Figure(), Figure()
    artists = draw(moving.subplots(), short.task, np.zeros(6), muted=True)
    move(artists, short.task, state)
    draw(still.subplots(), short.task, state)
    for figure in (moving, still):
        figure.axes[0].set(xlim=(-1, 1), ylim=(-0.2, 1.5))
    assert png(moving) == png(still)


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


def test_every_criterion_has_its_words(study: Study) -> None:
    assert {criterion.words for criterion in study.task.criteria} == set(FAILURES)
    for words, state in FAILURES.items():
        assert study.task.words(study.task.failure(np.array(state))) == words


@pytest.mark.parametrize("words", list(FAILURES)[:2])
def test_a_failure_is_shown(study: Study, words: str) -> None:
    """A failed rollout is pale at its failing frame, with time and words; nothing is drawn after it."""
    task, state = study.task, np.array(FAILURES[words])
    rollout = Rollout(np.array([ORIGIN, state]), np.zeros((1, 1)), 1, task.failure(state))
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
    for words in ("1.5 s", "nominal model", "hardware", f"{fallen.failed_at / 1000:.2f} s:"):
        assert words in texts(figure)


def test_snapshot_is_of_its_time(study: Study, balanced: Rollout) -> None:
    figure = snapshots(study.task, {"hardware": balanced}, [0.0, 2.5])
    wheel = figure.axes[1].patches[0]
    np.testing.assert_allclose(wheel.center, study.task.pose(balanced.states[2500][:3]).wheel)


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


@pytest.mark.usefixtures("uncompiled")
def test_a_drawing_of_ones_own(of_point_mass) -> None:
    """Without one, there are no snapshots."""

    def draw_mass(axes, task, state, *, color="0.4", muted=False):
        return {"mass": axes.add_patch(Circle((state[0], 0.0), 0.05, color=color))}

    study, _ = of_point_mass
    rollouts = {"simulation": study.simulate(np.array([1.0, 1.0, 0.0]))}
    assert drawing_of(study.task) is None
    with pytest.raises(NoPictureError, match="nothing draws PointMass"):
        snapshots(study.task, rollouts, [0.0])
    assert len(snapshots(study.task, rollouts, [0.0, 1.0], draw_mass).axes) == 2


def test_no_drawings_need_no_view() -> None:
    share_view([])
