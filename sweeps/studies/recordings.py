"""Learn from recordings of a real robot, predict others: how well, and how sure of it.

    python sweeps/studies/recordings.py FOLDER [OTHERS]

FOLDER holds acrobot_*, pendubot_* and excitation_* of a double pendulum (sweeps/results/recordings/HOW.md).
From one, two and five recordings of a kind, all others of FOLDER are predicted; or those of OTHERS, from
which nothing is learned.

Measured are, of joint 1 and joint 2: the root mean square error of the velocity after 0.1 s, from a measured
state under the measured torques, in windows in which a velocity changes by more than 0.3 rad/s. Of both
together: the negative log-likelihood of these errors, and the share of them in the 90% region, where errors
are normal with the covariance that they have in the recordings that were learned from.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import chi2

import simbias
from simbias.core import FittedBias, Nominal
from simbias.core.records import Array, Rollout
from simbias.simulation.open_loop import PredictionModel, Windows, predict
from simbias.trial.study import Study

KINDS = ("acrobot", "pendubot", "excitation")
COUNTS = (1, 2, 5)  # recordings that are learned from
COLORS = ("#999999", "#d55e00", "#009e73", "#0072b2")  # told apart by everybody, and in print
MOST = 2  # choices of several
SHIFTS = (0, 10, 20, 30, 40)  # frames by which windows are shifted, to have more of them
DURATION, CHANGE = 0.1, 0.3  # s, rad/s
COLUMNS = {"pos1": "pos_meas1", "pos2": "pos_meas2", "vel1": "vel_meas1", "vel2": "vel_meas2"}
COLUMNS |= {"tau1": "tau_meas1", "tau2": "tau_meas2"}
LAB = {  # model_1.0
    "damping_1": 0.001,
    "damping_2": 0.001,
    "friction_1": 0.16,
    "friction_2": 0.12,
    "rotor_inertia": 6.2872e-5,
}
OPTIONS = [
    *("preset=double_pendulum", "tracking=none"),
    "hardware.columns={" + ",".join(f"{key}:{name}" for key, name in COLUMNS.items()) + "}",
]


def load(folder: Path, *more: str) -> Study:
    """The double pendulum, its recordings the hardware."""
    return simbias.load([*OPTIONS, f"hardware.folder={folder}", *more])


def windows(rollouts: Sequence[Rollout], time_step: float) -> Windows:
    """All windows of recordings."""
    cut = [
        Rollout(r.states[: len(r.states) - shift], r.inputs[: len(r.inputs) - shift])
        for r in rollouts
        for shift in SHIFTS
    ]
    return Windows.of(cut, round(DURATION / time_step), 1)


def errors(nominal: Nominal, bias: FittedBias | None, some: Windows) -> Array:
    """Errors (w, 2) of the velocities after each window in which one changes."""
    predicted, measured = predict([PredictionModel(nominal)], some, bias)[0, :, -1], some.means[:, -1]
    changes = np.abs(measured - some.states[some.starts])[:, 2:]
    return (predicted - measured)[(changes > CHANGE).any(axis=1), 2:]


def choices(files: Sequence[str]) -> Iterator[tuple[str, int, tuple[str, ...]]]:
    """What is learned from: a kind, how many of it, and their names."""
    for kind, count in itertools.product(KINDS, COUNTS):
        own = [file for file in files if file.startswith(kind)]
        some = list(itertools.combinations(own, count)) or ([tuple(own)] if count == COUNTS[-1] else [])
        step = max(1, -(-len(some) // MOST))
        for names in some[::step] if count > 1 else some:
            yield kind, len(names), names  # of four all, where five are asked for


def models(folder: Path, rollouts: Sequence[Rollout]) -> Iterator[tuple[str, Nominal, FittedBias | None]]:
    """Every way to learn, by name."""
    study = load(folder, "identification=posterior_forward", "bias=window_gp")
    lab = load(folder, *(f"nominal.drives.{key}={value}" for key, value in LAB.items()))
    identified = study.identification.fit(study.nominal, rollouts)
    yield "nominal", study.nominal, None
    yield "lab", lab.nominal, None
    yield "residual", study.nominal, study.bias.learn(study.no_data, rollouts, study.nominal)
    yield "identified", identified, None
    yield "identified and residual", identified, study.bias.learn(study.no_data, rollouts, identified)


def rows(folder: Path, others: Path | None) -> Iterator[dict[str, object]]:
    """A row for each choice, way to learn and kind that is predicted."""
    study = load(folder)
    step = study.task.time_step
    known = {file: study.hardware.rollout(file) for file in study.hardware.files}
    study = load(others or folder)
    apart = {file: study.hardware.rollout(file) for file in study.hardware.files} if others else known
    for kind, count, names in choices(list(known)):
        learned = [known[name] for name in names]
        for name, nominal, bias in models(folder, learned):
            fitted = errors(nominal, bias, windows(learned, step))
            covariance = fitted.T @ fitted / len(fitted)
            for predicted in KINDS:
                left = [apart[f] for f in apart if f.startswith(predicted) and (others or f not in names)]
                if not left:
                    continue
                e = errors(nominal, bias, windows(left, step))
                size = np.einsum("wi,ij,wj->w", e, np.linalg.inv(covariance), e)
                yield {
                    "kind": kind,
                    "count": count,
                    "learned": " ".join(names),
                    "model": name,
                    "predicted": predicted,
                    **{f"rmse_{i + 1}": value for i, value in enumerate(np.sqrt(np.mean(e**2, axis=0)))},
                    "nll": float(0.5 * np.mean(size) + 0.5 * np.log(np.linalg.det(2 * np.pi * covariance))),
                    "within_90": float(np.mean(size < chi2.ppf(0.9, 2))),
                    "windows": len(e),
                }
        print(kind, count, names, file=sys.stderr, flush=True)


def ratios(table: pd.DataFrame) -> pd.DataFrame:
    """Of each choice and model: the mean over kinds and joints of the errors over the lab's."""
    joints = ["rmse_1", "rmse_2"]
    indexed = table.set_index(["kind", "count", "learned", "predicted", "model"])[joints]
    relative = indexed / indexed.xs("lab", level="model").reindex(indexed.index.droplevel("model")).to_numpy()
    each = relative.mean(axis=1).groupby(["kind", "count", "learned", "model"]).mean()
    return each.rename("ratio").reset_index()


def summary(table: pd.DataFrame) -> str:
    """Tables as markdown: over the lab's model, and the errors themselves."""
    each = ratios(table)
    order = list(dict.fromkeys(table["model"]))
    grouped = each.groupby(["kind", "count", "model"])["ratio"]
    text = "| learned from | recordings | choices | " + " | ".join(order) + " |\n"
    text += "| --- " * (3 + len(order)) + "|\n"
    for (kind, count), own in each.groupby(["kind", "count"], sort=False):
        cells = [grouped.get_group((kind, count, model)) for model in order]
        values = [f"{c.mean():.2f} ({c.min():.2f} to {c.max():.2f})" for c in cells]
        text += f"| {kind} | {count} | {own['learned'].nunique()} | " + " | ".join(values) + " |\n"
    text += "\n| model | predicted | joint 1 (rad/s) | joint 2 (rad/s) | NLL (nats) | within 90% |\n"
    text += "| --- " * 6 + "|\n"
    ones = table[table["count"] == 1]
    for (model, predicted), own in ones.groupby(["model", "predicted"], sort=False):
        means = own[["rmse_1", "rmse_2", "nll", "within_90"]].mean()
        text += f"| {model} | {predicted} | {means.iloc[0]:.3f} | {means.iloc[1]:.3f} | {means.iloc[2]:.2f} "
        text += f"| {100 * means.iloc[3]:.0f}% |\n"
    return text


def figure(table: pd.DataFrame, file: Path) -> None:
    """Errors over the lab's, for each choice."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    each = ratios(table)
    order = [model for model in dict.fromkeys(table["model"]) if model != "lab"]
    fig, all_axes = pyplot.subplots(1, len(KINDS), figsize=(7.2, 3.0), sharey=True, layout="constrained")
    for axes, kind in zip(all_axes, KINDS, strict=True):
        of_kind = each[each["kind"] == kind]
        counts = sorted(of_kind["count"].unique())
        for i, model in enumerate(order):
            own = of_kind[of_kind["model"] == model]
            places = [counts.index(count) + 0.16 * (i - 1.5) for count in own["count"]]
            axes.plot(places, own["ratio"], "os^D"[i], markersize=4, color=COLORS[i], alpha=0.8, label=model)
        axes.axhline(1.0, color="0.5", linewidth=0.8)
        axes.set_yscale("log", base=2)
        axes.set_yticks([0.5, 1, 2, 4], ["0.5", "1", "2", "4"])
        axes.set_xticks(range(len(counts)), [str(count) for count in counts])
        axes.set_title(f"learned from {kind}", fontsize="medium")
    all_axes[0].set_ylabel("error over the lab's model")
    fig.supxlabel("recordings learned from", fontsize="medium")
    handles, labels = all_axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper center", ncols=len(order), frameon=False, fontsize="small")
    fig.savefig(file, dpi=150)


def main() -> None:
    """Write the table, the summary and the figure to the current folder."""
    folder, others = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve() if len(sys.argv) > 2 else None
    table = pd.DataFrame()
    for row in rows(folder, others):
        table = pd.concat([table, pd.DataFrame([row])], ignore_index=True)
        table.to_csv("recordings.csv", index=False, float_format="%.5g")
    Path("table.md").write_text(summary(table))
    figure(table, Path("recordings.png"))
    print(summary(table))


if __name__ == "__main__":
    main()
