"""The drawing of a task against its geometry, in snapshots too."""

import importlib
import sys
import warnings
from copy import copy
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from figures import texts
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from PIL import Image

import simbias
from simbias.core.records import Array, Iteration, Rollout
from simbias.pictures import drawing_of, snapshots
from simbias.pictures.elements import style
from simbias.pictures.elements.drawing import NoPictureError, share_view
from simbias.pictures.elements.style import HARDWARE, SIMULATION, png
from simbias.pictures.trial import animation
from simbias.pictures.trial.comparison import NamedRollout
from simbias.robots.bongoboard.task_drawing import draw, move
from simbias.trial.study import Study

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


def centre(patch) -> Array:
    """Centre of a drawn circle or box."""
    return np.array(patch.center) if isinstance(patch, Circle) else patch.get_xy()[:4].mean(axis=0)


def direction(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def test_moving_is_drawing_anew(study: Study) -> None:
    state = np.random.default_rng(0).normal(0.0, 0.4, 6)
    moving, still = Figure(), Figure()
    artists = draw(moving.subplots(), study.task, np.zeros(6), muted=True)
    move(artists, study.task, state)
    draw(still.subplots(), study.task, state)
    for figure in (moving, still):
        figure.axes[0].set(xlim=(-1, 1), ylim=(-0.2, 1.5))
    assert png(moving) == png(still)


def test_drawing_agrees_with_the_pose(study: Study) -> None:
    """Every part is where the task's geometry has it, to scale; the wheel turns as it rolls."""
    robot, state = study.task.robot, np.random.default_rng(0).normal(0.0, 0.4, 6)
    pose, artists = study.task.pose(state[:3]), draw(Figure().subplots(), study.task, state)
    at = {name: centre(artist) for name, artist in artists.items() if isinstance(artist, Patch)}
    np.testing.assert_allclose(at["wheel"], pose.wheel)
    np.testing.assert_allclose(at["board"], pose.board)
    for joint, place in {"ankle": pose.ankles, "hip": pose.pelvis}.items():
        left, right = (at[f"{side} {joint}"] for side in ("left", "right"))
        np.testing.assert_allclose((left + right) / 2, place, atol=1e-12)
        apart = robot.ankle_spacing * direction(pose.board_angle)
        np.testing.assert_allclose(right - left, apart, atol=1e-12)
    for side in ("left", "right"):
        leg = at[f"{side} hip"] - at[f"{side} ankle"]
        np.testing.assert_allclose(leg, robot.leg_length * direction(pose.leg_angle + np.pi / 2), atol=1e-12)
        np.testing.assert_allclose(at[f"{side} leg"], at[f"{side} ankle"] + leg / 2)
    corners = artists["board"].get_xy()
    board = robot.board_length * direction(pose.board_angle)
    np.testing.assert_allclose(corners[1] - corners[0], board, atol=1e-12)
    rolled = np.array([np.pi / 2, -np.pi / 2, 0, 0, 0, 0])  # to the left, so counter-clockwise
    hub, *_, rim = draw(Figure().subplots(), study.task, rolled)["sector"].get_xy()[:6]
    assert hub[0] == pytest.approx(-robot.wheel_radius * np.pi / 2)
    np.testing.assert_allclose(rim - hub, [-robot.wheel_radius, 0.0], atol=1e-12)


def test_a_failure_is_shown(study: Study) -> None:
    """A failed rollout is pale at its failing frame, with time and words; nothing is drawn after it."""
    task = study.task
    assert {criterion.words for criterion in task.criteria} == set(FAILURES)
    for words, state in FAILURES.items():
        assert task.words(task.failure(np.array(state))) == words
    words, state = next(iter(FAILURES.items()))
    states = np.array([np.zeros(6), state])
    rollout = Rollout(states, np.zeros((1, 1)), 1, task.failure(states[1]))
    figure = snapshots(task, {"hardware": rollout}, [0.0, 0.001, 0.002])
    before, failing, after = figure.axes
    assert {patch.get_alpha() for patch in before.patches} == {1.0}
    assert all(patch.get_alpha() < 1.0 for patch in failing.patches)
    assert f"0.00 s: {words}" in texts(figure).replace("\n", " ")
    np.testing.assert_allclose(failing.patches[0].center, task.pose(states[1, :3]).wheel)
    assert not after.has_data()


@pytest.mark.slow
def test_snapshots_have_one_scale_and_show_all(study: Study) -> None:
    """Each is of its time."""
    fallen, balanced = study.simulate(np.zeros(5)), study.simulate(BALANCING)
    balanced = replace(balanced, measured=balanced.states)
    figure = snapshots(study.task, {"nominal model": fallen, "hardware": balanced}, [0.0, 1.5, 5.0])
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}) == 1
    assert [figure.axes[row].texts[0].get_color() for row in (0, 3)] == [SIMULATION, HARDWARE]
    (left, right), (bottom, top) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        if axes.has_data():
            assert left < axes.dataLim.x0 < axes.dataLim.x1 < right
            assert bottom < axes.dataLim.y0 < axes.dataLim.y1 < top
    for words in ("1.5 s", "nominal model", "hardware", f"{fallen.failed_at / 1000:.2f} s:"):
        assert words in texts(figure)
    wheel = snapshots(study.task, {"hardware": balanced}, [0.0, 2.5]).axes[1].patches[0]
    np.testing.assert_allclose(wheel.center, study.task.pose(balanced.states[2500][:3]).wheel)
    share_view([])  # no drawings need no view
    tall = Figure().add_subplot()
    tall.plot([0.0, 0.1], [0.0, 9.0])
    share_view([tall])
    (left, right), (bottom, top) = tall.get_xlim(), tall.get_ylim()
    assert (top - bottom) / (right - left) == pytest.approx(2.0)
    assert left + right == pytest.approx(0.1)


def test_figures_leave_pyplot_alone(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is never imported: no display is needed, no figure stays open."""
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    monkeypatch.setattr(simbias, "pictures", simbias.pictures)
    for name in [name for name in sys.modules if name.startswith("simbias.pictures")]:
        monkeypatch.delitem(sys.modules, name)
    rollout = Rollout(np.zeros((2, 6)), np.zeros((1, 1)))
    importlib.import_module("simbias.pictures").snapshots(study.task, {"a": rollout}, [0.0])


def test_a_drawing_of_ones_own(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    """Without one, there are no snapshots."""

    def draw_mass(axes, task, state, *, color="0.4", muted=False):
        return {"mass": axes.add_patch(Circle((state[0], 0.0), 0.05, color=color))}

    study, _ = of_point_mass
    rollouts = {"simulation": study.simulate(np.array([1.0, 1.0, 0.0]))}
    assert drawing_of(study.task) is None
    with pytest.raises(NoPictureError, match="nothing draws PointMass"):
        snapshots(study.task, rollouts, [0.0])
    assert len(snapshots(study.task, rollouts, [0.0, 1.0], draw_mass).axes) == 2


@pytest.mark.slow
def test_an_animation_shows_all_scenes_and_all_places_of_lines(
    of_point_mass: tuple[Study, list[Iteration]], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Axes] = []

    def draw_rod(axes, task, state, *, color="0.4", muted=False):
        shown.append(axes)
        return {"rod": axes.plot([0.0, state[0]], [0.0, 1.0])[0]}

    def move_rod(artists, task, state, *, muted=False):
        artists["rod"].set_xdata([0.0, state[0]])

    monkeypatch.setattr(animation, "drawing_of", lambda task: draw_rod)
    monkeypatch.setattr(animation, "movement_of", lambda task: move_rod)
    moving = Rollout(np.linspace([0.0, 0.0], [5.0, 0.0], 4), np.zeros((3, 1)))
    animation.animate(of_point_mass[0].task, 4 * [NamedRollout("four", moving)], "", BytesIO())
    for axes in shown:
        box, (left, right) = axes.get_position(), axes.get_xlim()
        assert left < 0.0 < 5.0 < right
        assert -1e-9 < box.x0 < box.x1 < 1 + 1e-9
    assert len(shown) == 4
    slow, file = copy(of_point_mass[0].task), BytesIO()
    slow.time_step = 60.0
    animation.animate(slow, [NamedRollout("one", moving)], "", file)  # 3 min are shown in 20 s
    picture = Image.open(file)
    assert (picture.n_frames, picture.info["duration"]) == (4, pytest.approx(20_000 / 3, abs=10))


@pytest.mark.slow
def test_labels_of_others_are_drawn_in_silence(tmp_path: Path) -> None:
    """Letters that no font has, and names for which there is no room."""
    figure = Figure(figsize=(1.0, 1.0), layout="constrained")
    labels = [f"\U0001f916{100 * 'x'}", "<b>&amp; one $"]
    for axes, label in zip(figure.subplots(len(labels)), labels, strict=True):
        axes.set(xlabel=label, title=label)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("a.png", "a.svg", "again.SVG", "a.pdf", "again.pdf"):
            style.save(figure, tmp_path / name)
    for name, again, head in (("a.svg", "again.SVG", b"<?xml"), ("a.pdf", "again.pdf", b"%PDF")):
        assert (tmp_path / name).read_bytes() == (tmp_path / again).read_bytes()
        assert (tmp_path / name).read_bytes().startswith(head)
    assert b"/Type3" not in (tmp_path / "a.pdf").read_bytes()
    assert "<b>" not in (tmp_path / "a.svg").read_text()
    with pytest.raises(ValueError, match=r"a\.jpg: a figure is saved as \.png, \.svg or \.pdf"):
        style.save(figure, "a.jpg")
