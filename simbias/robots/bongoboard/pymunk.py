"""The bongoboard in pymunk, a 2D physics engine in place of the robot (Section VI-A)."""

from __future__ import annotations

from typing import final

from simbias.core.ranges import Count
from simbias.core.records import Array
from simbias.robots.bongoboard.bodies import Feet
from simbias.robots.bongoboard.gaps import NO_GAPS, Gaps
from simbias.robots.bongoboard.hardware import Depth, EngineBongoboard, InertiaError
from simbias.robots.bongoboard.pymunk_world import World
from simbias.robots.bongoboard.task import Bongoboard
from simbias.simulation.control_loop import Record
from simbias.simulation.noise import QUIET, Variances


@final
class PymunkBongoboard(EngineBongoboard):
    """Wheel, board, feet, two legs and pelvis as rigid bodies; the feet stand on the board by contact alone.

    Parameters
    ----------
    task, inertia_error, noise, record, detachment
        As of every `EngineBongoboard`; a frame is one step of the engine.
    feet
        "plate": one plate under both ankles; "separate": the plate cut in two, an ankle above the middle of
        each half; "fixed": the plate joined to the board, as in the Lagrangian model.
    iterations
        Of the engine's solver in each frame.
    overlap
        How deep, in m, bodies in contact may overlap.
    gaps
        What it has and its model has not (`Gaps`). Noise on the torque passes the motor, too.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: InertiaError = 0.0,
        feet: Feet = "plate",
        noise: Variances = QUIET,
        record: Record = "true_state",
        iterations: Count = 50,
        overlap: Depth = 1e-4,
        detachment: Depth = 1e-3,
        gaps: Gaps = NO_GAPS,
    ) -> None:
        super().__init__(task, inertia_error, noise, record, detachment, gaps)
        self._feet = feet
        self._iterations = iterations
        self._overlap = overlap
        self._gaps = gaps

    def build(self, start: Array) -> World:
        """The engine's world at a start (6,), as an experiment begins with it."""
        return World(self._task, start, self._scale, self._feet, self._iterations, self._overlap, self._gaps)
