"""A policy on the nominal model, on the corrected one and on hardware, moving side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import IO, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from PIL import Image

from simbias.core import Task
from simbias.core.records import Iteration, Rollout
from simbias.pictures.elements.drawing import Movement, NoPictureError, drawing_of, movement_of, share_view
from simbias.pictures.elements.style import SMALL, seconds
from simbias.pictures.trial.comparison import (
    NamedRollout,
    compared_words,
    hardware_words,
    in_simulation,
    learned_before,
    on_hardware,
    on_nominal,
    worst_experiment,
)
from simbias.pictures.trial.snapshots import ending_words
from simbias.trial.study import Study

WIDTH, EACH, DOTS_PER_INCH = 6.6, 2.2, 100  # in: minimum width of the picture, and width of each drawing
HEAD, FOOT = 0.55, 0.4  # in, above and below the drawings
MOST_SECONDS = 20.0  # longer rollouts are shown faster than real time
PICTURE_SECONDS = 0.1  # GIF times are in hundredths of a second
LAST = 1500  # ms, duration of the last picture
COLORS, NEARLY_WHITE = 24, 245
LINE = 34  # characters
VIEW_FRAMES = 20  # of each rollout, to find a view that contains it


class Scene(NamedTuple):
    """A rollout, and its axes and artists."""

    axes: Axes
    rollout: Rollout
    artists: Mapping[str, Artist]
    clock: Text


def save_animation(study: Study, iterations: Sequence[Iteration], file: Path | str | IO[bytes]) -> None:
    """Write a GIF of the last policy in simulation and of the worst experiment, as `animate` does.

    All begin at the experiment's start: the nominal model alone, the corrected model used to optimise the
    policy (if anything was learned), and the hardware. A failed rollout freezes and turns pale.

    Raises
    ------
    NoPictureError
        If the task has no drawing, or none that moves, or no policy was tried on the hardware.
    """
    iteration = on_hardware(iterations)[-1]
    experiment = worst_experiment(study, iteration)
    rollouts: list[NamedRollout | None] = [on_nominal(study, iteration, experiment)]
    if learned_before(iterations, iteration):
        rollouts.append(in_simulation(study, iterations, iteration, experiment))
    rollouts.append(NamedRollout(hardware_words(study), experiment))
    animate(study.task, [each for each in rollouts if each], compared_words(study, iteration), file)


def animate(
    task: Task, rollouts: Sequence[NamedRollout], headline: str, file: Path | str | IO[bytes]
) -> None:
    """Write a GIF of rollouts side by side, each under its name, in color.

    It runs in real time; longer rollouts are compressed to `MOST_SECONDS`. Errors as for `save_animation`.
    """
    draw, move = drawing_of(task), movement_of(task)
    if draw is None or move is None:
        raise NoPictureError(f"nothing draws and moves {type(task).__name__}")
    figure = Figure(dpi=DOTS_PER_INCH)
    scenes = []
    for index, (name, rollout, color, _) in enumerate(rollouts):
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), label=str(index))
        axes.set_title(fill(name, LINE), fontsize=SMALL, color=color)
        artists = draw(axes, task, rollout.states[0], color=color)
        clock = axes.text(0.5, -0.02, "", transform=axes.transAxes, ha="center", va="top", fontsize=SMALL)
        scenes.append(Scene(axes, rollout, artists, clock))
    _lay_out(figure, task, scenes, move)
    figure.suptitle(headline, fontsize="medium", fontweight="bold", y=0.98)
    longest = max(scene.rollout.frames for scene in scenes)
    faster = max(1.0, longest * task.time_step / MOST_SECONDS)
    step = max(1, round(faster * PICTURE_SECONDS / task.time_step))
    pictures = list(_pictures(figure, task, scenes, move, [*range(0, longest, step), longest]))
    each = round(1000 * seconds(task, step) / faster)
    first, *others = pictures
    durations = [each] * len(others) + [LAST]
    first.save(file, "GIF", save_all=True, append_images=others, duration=durations, loop=0)


def _lay_out(figure: Figure, task: Task, scenes: Sequence[Scene], move: Movement) -> None:
    """Put the scenes side by side, with a common view of all their frames."""
    for axes, rollout, artists, _ in scenes:
        for frame in np.linspace(0, rollout.frames, VIEW_FRAMES).round().astype(int):
            move(artists, task, rollout.states[frame])
            for artist in artists.values():
                if isinstance(artist, Patch):
                    axes.update_datalim(artist.get_patch_transform().transform(artist.get_path().vertices))
                elif isinstance(artist, Line2D):
                    axes.update_datalim(artist.get_xydata())
    share_view([scene.axes for scene in scenes])
    (left, right), (bottom, top) = scenes[0].axes.get_xlim(), scenes[0].axes.get_ylim()
    height = EACH * (top - bottom) / (right - left)
    total, width = HEAD + height + FOOT, max(WIDTH, EACH * len(scenes))
    figure.set_size_inches(width, total)
    for i, scene in enumerate(scenes):
        at = width / 2 + (i - len(scenes) / 2) * EACH
        scene.axes.set_position((at / width, FOOT / total, EACH / width, height / total))


def _pictures(
    figure: Figure, task: Task, scenes: Sequence[Scene], move: Movement, frames: Sequence[int]
) -> Iterator[Image.Image]:
    """The scenes at the frames; static parts are drawn once."""
    moving = [(s.axes, artist) for s in scenes for artist in (*s.artists.values(), s.clock)]
    for _, artist in moving:
        artist.set_animated(True)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    palette = None
    for frame in frames:
        canvas.restore_region(still)
        for _, rollout, artists, clock in scenes:
            now = min(frame, rollout.frames)
            failed = rollout.failed_at is not None and now == rollout.frames
            move(artists, task, rollout.states[now], muted=failed)
            words = ending_words(task, rollout) if failed else f"{seconds(task, now):.2f} s"
            clock.set_text(fill(words, LINE))
        for axes, artist in moving:
            axes.draw_artist(artist)
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        palette = palette or _palette(picture)
        yield picture.quantize(palette=palette, dither=Image.Dither.NONE)


def _palette(picture: Image.Image) -> Image.Image:
    """The palette of a picture; near-white becomes white, as before averaging of colors."""
    palette = picture.quantize(COLORS, dither=Image.Dither.NONE)
    colors = np.array(palette.getpalette()).reshape(-1, 3)
    colors[colors.min(axis=1) >= NEARLY_WHITE] = 255
    palette.putpalette(colors.ravel().tolist())
    return palette
