"""What MuJoCo renders is what the stick figure shows; where it cannot render, that is drawn."""

import re
import subprocess
import sys
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import PYTHONPATH
from mechanisms import DOUBLE, cart_pole, drawn_from
from scipy.spatial import ConvexHull

from simbias.core.records import Array
from simbias.pictures.elements.drawing import drawing_of, movement_of
from simbias.robots.mujoco.rendering import Image

ROBOT = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1"/>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0"/>
      <geom name="hull" type="ellipsoid" size="0.3 0.1 0.1" rgba="1 0 0 1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider" gear="20"/></actuator>
</mujoco>
"""


def slider(file: Path, unit: str = "m") -> Any:
    """A slider, or a hinge, drawn from a file of which a stick figure lacks the hull."""
    states = {"x": {"unit": unit}, "d_x": {"unit": f"{unit}/s"}}
    inputs = {"force": {"unit": "N" if unit == "m" else "N m", "limit": 20.0}}
    leaves = {"value": "abs(x)", "above": 1.0}
    return cart_pole(states=states, inputs=inputs, failure={"leaves": leaves}, figure={"file": str(file)})


def rendered(task: Any, x: Array) -> Image:
    """The image of a task; the test is skipped where OpenGL cannot run."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            image = task.image(x)
        except UserWarning as error:
            pytest.skip(str(error))
    return image


def opaque(image: Image, point: Array) -> bool:
    """Whether there is something at a point (2,) in m."""
    (left, right, bottom, top), (height, width) = image.extent, image.pixels.shape[:2]
    column, row = (point[0] - left) / (right - left) * width, (top - point[1]) / (top - bottom) * height
    return 0 <= row < height and 0 <= column < width and bool(image.pixels[int(row), int(column), 3])


@pytest.mark.slow
def test_an_image_is_where_the_stick_figure_is() -> None:
    task, x = drawn_from(file=DOUBLE, rendered=True), np.array([0.3, 0.1, -0.4, 0.0, 0.0, 0.0])
    image, parts = rendered(task, x), drawn_from(file=DOUBLE).points(x)
    for name in ("cpole", "cpole2"):
        low, high = parts[name]
        along = (high - low) / np.linalg.norm(high - low)
        edge = task.drawing[name].thickness / 2 * np.array([-along[1], along[0]])
        for share, width in product((0.2, 0.8), (-1.2, -0.9, 0.9, 1.2)):
            point = low + share * (high - low) + width * edge
            assert opaque(image, point) == (abs(width) < 1)


@pytest.mark.slow
def test_what_a_stick_figure_lacks_is_rendered_moved_and_tinted(tmp_path: Path) -> None:
    """An ellipsoid is; the floor, a plane, is left out of both. Where nothing lacks, nothing is rendered."""
    from matplotlib.figure import Figure

    assert drawn_from(file=DOUBLE).image(np.zeros(6)) is None
    (tmp_path / "robot.xml").write_text(ROBOT)
    task = slider(tmp_path / "robot.xml")
    image = rendered(task, np.array([0.5, 0.0]))
    for x, y, inside in ((0.5, 0.0, True), (0.78, 0.0, True), (0.5, 0.11, False), (0.5, -0.11, False)):
        assert opaque(image, np.array([x, y])) == inside
    draw, move = drawing_of(task), movement_of(task)
    assert draw is not None
    assert move is not None
    axes = Figure().add_subplot()
    artists = draw(axes, task, np.zeros(2), color="tab:blue")
    (picture,) = axes.images
    there = np.array(picture.get_extent())
    pixels = picture.get_array()
    middle = pixels[len(pixels) // 2, len(pixels[0]) // 2]
    assert middle[0] > middle[1]  # the hull is red,
    assert middle[2] > middle[1]  # the figure's colour blue
    move(artists, task, np.array([0.4, 0.0]), muted=True)
    np.testing.assert_allclose(np.array(picture.get_extent()) - there, [0.4, 0.4, 0.0, 0.0], atol=2e-3)
    assert picture.get_alpha() < 1


@pytest.mark.slow
def test_without_opengl_a_stick_figure_is_drawn() -> None:
    """As on a machine that has no such device; it is said once."""
    code = """
import warnings, numpy as np
from mechanisms import DOUBLE, drawn_from
task = drawn_from(file=DOUBLE, rendered=True)
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    assert task.image(np.zeros(6)) is None and task.image(np.zeros(6)) is None
print([str(each.message) for each in said])
"""
    environment = {"MUJOCO_EGL_DEVICE_ID": "99", "PATH": "", "PYTHONPATH": PYTHONPATH}
    command = [sys.executable, "-c", code]
    made = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    said = "a stick figure is drawn: OpenGL cannot run here without a screen (EGL)"
    assert made.stdout.strip() == str([said]), made.stderr


def test_a_flat_robot_is_seen_from_the_side_that_it_moves_in(tmp_path: Path) -> None:
    """A hinge turns in the plane across its axis."""
    flat = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body>
      <joint name="hinge" type="hinge" axis="{axis}"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.3 0.2 0.1" size="0.02"/></body></worldbody>
      <actuator><motor name="motor" joint="hinge" gear="20"/></actuator></mujoco>"""
    for axis, plane in (("1 0 0", [1, 2]), ("0 1 0", [0, 2]), ("0 0 1", [0, 1])):
        file = tmp_path / f"{axis}.xml"
        file.write_text(flat.format(axis=axis))
        task, straight = slider(file, "rad"), np.array([0.3, 0.2, 0.1])
        for angle, sign in ((0.0, 1.0), (np.pi, -1.0)):
            middle = task.points(np.array([angle, 0.0]))["arm"].mean(axis=0)
            np.testing.assert_allclose(middle, sign * straight[plane] / 2, atol=1e-9)


@pytest.mark.parametrize("euler", ["0 0 0", "90 0 0", "0 90 0", "0 30 0", "20 30 40", "90 90 90"])
def test_the_outline_of_a_box_holds_all_its_corners(tmp_path: Path, euler: str) -> None:
    """However it is turned, it is the convex hull of the eight, from the side."""
    box = f'''<geom name="bar" type="box" size="0.05 0.03 0.2" pos="0.1 0.2 0.3" euler="{euler}" mass="1"/>'''
    (tmp_path / "box.xml").write_text(re.sub('<geom name="hull".*/>', box, ROBOT))
    outline = slider(tmp_path / "box.xml").points(np.array([0.5, 0.0]))["bar"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "box.xml"))
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom("bar").quat)
    signs = np.array(list(product((-1, 1), repeat=3)))
    corners = (signs * [0.05, 0.03, 0.2] @ turn.reshape(3, 3).T + [0.6, 0.2, 0.3])[:, [0, 2]]
    hull = ConvexHull(corners)
    x, z = outline.T
    assert len(outline) in (4, 6)
    assert 0.5 * (x @ np.roll(z, -1) - z @ np.roll(x, -1)) == pytest.approx(hull.volume)  # its area
    distances = np.linalg.norm(outline[:, None] - corners[hull.vertices], axis=2)
    np.testing.assert_allclose([*distances.min(axis=0), *distances.min(axis=1)], 0.0, atol=1e-12)


@pytest.mark.parametrize("shape", ["cylinder", "capsule"])
@pytest.mark.parametrize("euler", ["90 0 0", "89 0 0", "20 30 40", "5 0 0"])
def test_a_wheel_is_a_disc_end_on_and_a_bar_with_round_ends_aslant(
    tmp_path: Path, euler: str, shape: str
) -> None:
    """The convex hull of its two circles, or of a capsule's two spheres, from the side."""
    wheel = f'<geom name="wheel" type="{shape}" size="0.1 0.02" euler="{euler}" mass="1"/>'
    (tmp_path / "wheel.xml").write_text(re.sub('<geom name="hull".*/>', wheel, ROBOT))
    outline = slider(tmp_path / "wheel.xml").points(np.array([0.5, 0.0]))["wheel"]
    turn, angle = np.empty(9), np.linspace(0.0, 2 * np.pi, 1000)
    mujoco.mju_quat2Mat(turn, mujoco.MjModel.from_xml_path(str(tmp_path / "wheel.xml")).geom("wheel").quat)
    circle = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(1000, 0.02)], axis=1)
    seen = np.concatenate([circle, -circle]) @ turn.reshape(3, 3).T[:, [0, 2]]
    if shape == "capsule":
        ends = [0.0, 0.0, 0.02] @ turn.reshape(3, 3).T[:, [0, 2]]
        seen = np.concatenate([circle[:, :2] + ends, circle[:, :2] - ends])
    assert ConvexHull(outline).volume == pytest.approx(ConvexHull(seen).volume, rel=0.01)  # its area
    np.testing.assert_allclose(np.ptp(outline, axis=0), np.ptp(seen, axis=0), rtol=0.01)
    np.testing.assert_allclose(outline.mean(axis=0), [0.5, 0.0], atol=1e-12)
