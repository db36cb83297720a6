"""How residuals are best recovered from measured states, as a function of the noise (rows of Table II).

`python sweeps/studies/smoothing.py FOLDER` makes experiments with the default trial's two policies, one of
which balances without noise, and takes residuals (Eq. 6) from what was measured, in several ways:

    w frames            their mean with the weights of a least-squares line (samples.window)
    Savitzky-Golay, w   states smoothed by cubic polynomials over w frames, then single steps
    RTS, w frames       states smoothed with the nominal model, the declared noise and a bias that drifts
                        (extended Kalman filter, Rauch-Tung-Striebel pass back), then means as above

It tells the median error of the residuals and, of a Gaussian process that learns from those that keep the
limits, the median error in other experiments: both against the true residuals, of true states and of the
torque that acted, and over their median.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter

import simbias
from simbias.core import Nominal
from simbias.core.records import Array, Rollout, Transitions
from simbias.learning.samples.thresholds import Thresholds, WindowLengths
from simbias.simulation.noise import Noise
from simbias.trial.study import Study

ROWS = {1: (0, 0, 0), 5: (0.1, 1e-6, 1e-3), 8: (0.1, 8e-6, 8e-3), 10: (0.1, 3.2e-5, 3.2e-2)}
ROWS |= {12: (0.1, 1.28e-4, 1.28e-1)}  # of Table II: variances of torque, angles, rates
DRIFT = 1e-3  # rad/s in a frame, standard deviation of the bias's step
EVERYTHING = dict.fromkeys(("distance", "body_angle", "board_angle", "speed"), 1e9)

Smoother = Callable[[Rollout, Nominal, Noise], Array]  # states (k+1, n) from a record of measured ones


def as_measured(rollout: Rollout, nominal: Nominal, noise: Noise) -> Array:
    """No smoothing."""
    return rollout.states


@dataclass(frozen=True)
class SavitzkyGolay:
    """Cubic polynomials over a window of frames."""

    window: int

    def __call__(self, rollout: Rollout, nominal: Nominal, noise: Noise) -> Array:
        """States that the model has no part in."""
        return savgol_filter(rollout.states, self.window, polyorder=3, axis=0)


def rts(rollout: Rollout, nominal: Nominal, noise: Noise) -> Array:
    """Rauch-Tung-Striebel: the state z = (x, b) moves by x + f'(x, u) + b, and b by a random walk."""
    n, (measured, inputs) = rollout.states.shape[1], (rollout.states, rollout.inputs)
    variances = np.maximum(noise.sensor_variance, 1e-10)
    R, Q = np.diag(variances), np.diag([*[1e-12] * n, *[1e-6 * DRIFT**2] * (n // 2), *[DRIFT**2] * (n // 2)])
    z, P = np.concatenate([measured[0], np.zeros(n)]), np.diag([*variances, *[1e-4] * n])
    filtered, predicted, slopes = [(z, P)], [], []
    for u, y in zip(inputs, measured[1:], strict=True):
        F = np.block([[jacobian(nominal, z[:n], u), np.eye(n)], [np.zeros((n, n)), np.eye(n)]])
        z, P = np.concatenate([nominal.step(z[:n], u) + z[n:], z[n:]]), F @ P @ F.T + Q
        predicted.append((z, P))
        slopes.append(F)
        K = np.linalg.solve(P[:n, :n] + R, P[:n]).T
        z, P = z + K @ (y - z[:n]), P - K @ P[:n]
        P = (P + P.T) / 2  # against rounding
        filtered.append((z, P))
    states = [z]
    for (z, P), (z_next, P_next), F in zip(filtered[-2::-1], predicted[::-1], slopes[::-1], strict=True):
        states.append(z + np.linalg.solve(P_next, F @ P).T @ (states[-1] - z_next))
    return np.array(states[::-1])[:, :n]


def jacobian(nominal: Nominal, x: Array, u: Array, h: float = 1e-5) -> Array:
    """Slope (n, n) of the nominal step in x (n,)."""
    return np.array([nominal.step(x + e, u) - nominal.step(x - e, u) for e in h * np.eye(len(x))]).T / (2 * h)


WAYS: dict[str, tuple[Smoother, int]] = {
    "single steps": (as_measured, 1),
    **{f"{window} frames": (as_measured, window) for window in (35, 71, 141)},
    **{f"Savitzky-Golay, {window}": (SavitzkyGolay(window), 1) for window in (35, 71)},
    "RTS, 35 frames": (rts, 35),
}


class Experiment(NamedTuple):
    """An experiment, and what nobody sees of it."""

    record: Rollout  # of measured states
    truth: Rollout  # true states, and the inputs that acted


def experiments(study: Study, noise: Noise, policies: list[Array], seed: int) -> list[Experiment]:
    """One with each policy; the noise is drawn a second time."""
    made = []
    for index, theta in enumerate(policies):
        true = study.experiment(theta, np.random.default_rng([seed, index]))
        rng = np.random.default_rng([seed, index])
        study.task.draw_start(rng)
        on_inputs = noise.draw(rng).inputs
        assert true.measured is not None
        record = replace(true, states=true.measured, sensed=True)
        made.append(Experiment(record, replace(true, inputs=true.inputs + on_inputs[: true.frames])))
    return made


def transitions(study: Study, rollouts: list[Rollout], window: int, limited: bool = True) -> Transitions:
    """Samples of so many frames, those that keep the study's limits or all."""
    config = study.config["samples"]
    limits = config["limits"] if limited else EVERYTHING
    residual = config["residual"] if limited else 1e9
    samples = Thresholds(study.task, config["stride"], limits, residual, WindowLengths(window, window))
    return samples.select(rollouts, study.nominal).transitions


def relative(errors: Array, truth: Array) -> float:
    """Median norm of errors (N, n) over the median norm of the truth (N, n)."""
    return float(np.median(np.linalg.norm(errors, axis=1)) / np.median(np.linalg.norm(truth, axis=1)))


def measure(row: int, policies: list[Array]) -> list[dict[str, object]]:
    """All ways at one level of noise."""
    names = ("torque_variance", "angle_variance", "velocity_variance")
    variances = dict(zip(names, ROWS[row], strict=True))
    values = [f"hardware.noise.{name}={value}" for name, value in variances.items()]
    study = simbias.load(["tracking=none", *values])
    noise = Noise(study.task, variances)
    learned_from, others = (experiments(study, noise, policies * 2, seed) for seed in (1, 2))
    held_out = transitions(study, [other.truth for other in others], 1)
    found: list[dict[str, object]] = []
    for way, (smoother, window) in {"true states": (as_measured, 1), **WAYS}.items():
        seen = [
            replace(made.record, states=made.truth.states if way == "true states" else states)
            for made in learned_from
            for states in [smoother(made.record, study.nominal, noise)]
        ]
        data = transitions(study, seen, window)
        truth = transitions(study, [made.truth for made in learned_from], window, limited=False)
        estimate = transitions(study, seen, window, limited=False)
        mean, _ = study.bias.fit(data).predict(held_out.inputs)
        found.append(
            {
                "row": row,
                "way": way,
                "samples": len(data),
                "error_of_residuals": relative(estimate.residuals - truth.residuals, truth.residuals),
                "error_of_what_is_learned": relative(mean - held_out.residuals, held_out.residuals),
            }
        )
    return found


def main(folder: Path) -> None:
    """Measure every way at every row, print the table and write it as smoothing.csv."""
    study = simbias.load(["tracking=none"])
    policies = [iteration.parameters for iteration in study.run()]
    table = [line for row in ROWS for line in measure(row, policies)]
    with (folder / "smoothing.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, table[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    print("row of Table II: samples, error of residuals, error of what is learned")
    print(" " * 20 + "".join(f"{row:>20}" for row in ROWS))
    for way in ("true states", *WAYS):
        cells = [line for line in table if line["way"] == way]
        numbers = (
            f"{cell['samples']:>6}{cell['error_of_residuals']:>7.2f}{cell['error_of_what_is_learned']:>7.2f}"
            for cell in cells
        )
        print(f"{way:20}" + "".join(numbers))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    main(parser.parse_args().folder)
