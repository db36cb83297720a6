"""Figures of trials that are made up: their numbers, each series told from all others, nothing cut off."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from errors import one_line
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from simbias.config.build import build
from simbias.core.proportions import wilson
from simbias.pictures.elements.layout import COLUMN, legend
from simbias.sweep import results
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import FigureError, SweptTrials
from simbias.sweep.figures.comparison import Comparison
from simbias.sweep.figures.costs import Costs
from simbias.sweep.figures.experiments import Experiments
from simbias.sweep.figures.last_policies import LastPolicies
from simbias.sweep.figures.success_rates import Range, SuccessRates
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.results import LATER

pytestmark = pytest.mark.slow

METHODS = "{LQR: {method: lqr}, LQI: {method: lqi, policy: integral_feedback}, ideal: {method: ideal}}"
LEARNERS = ["gp", "sparse_gp", "gp_learned", "none"]
EVALUATIONS = ["nominal_start", "domain_randomization"]


def swept(sweep: Sweep, rows: list[dict[str, Any]], load: Any = None) -> SweptTrials:
    """Trials of a sweep: these rows."""
    return SweptTrials(sweep, pd.DataFrame(rows), load)


def assert_nothing_is_cut(figure: Figure) -> None:
    """The legend is inside of the figure, above all axes."""
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= box.x0 < box.x1 <= whole.x1
    assert box.y1 <= whole.y1
    assert all(axes.get_window_extent().y1 <= box.y0 + 1 for axes in figure.axes)


def test_comparisons_numbers_are_those_of_the_trials() -> None:
    axes = f"{{cell: {{points: {{cart-pole: {{preset: cartpole}}}}}}, method: {{points: {METHODS}}}}}"
    sweep = expand([f"+sweep={{trials: 3, common_seeds: [method], axes: {axes}}}"])

    def made_up(texts: dict[str, list[str]], policy: str = "") -> SweptTrials:
        """Trials whose last policies last in these test episodes, "-" untested; an error where none is."""
        rows = [
            {"cell": "cart-pole", "method": method, "hash": trial.hash, "repetition": trial.repetition}
            | {"policy": policy, "experiments": 2.0 + trial.repetition if text else np.nan}
            | {"outcome": "succeeded" if text else "error"}
            | dict.fromkeys(("test_episodes", "lasting_episodes"), text.strip("-"))
            for trial in sweep.trials
            if (method := trial.cell.labels[1]) in texts
            for text in [texts[method][trial.repetition]]
        ]
        return swept(sweep, rows)

    all_of_16, half, fallen = "1" * 16, "10" * 8, "0" * 16
    texts = {"LQI": [half, half, fallen], "ideal": [all_of_16] * 3, "LQR": [fallen, fallen, ""]}
    picture = Comparison("method", ["LQI"]).draw(made_up(texts), ())
    numbers = picture.numbers.set_index("method")
    assert numbers["holds"].to_dict() == {"LQR": 0, "LQI": 0, "ideal": 3}
    assert numbers["raised"].to_dict() == {"LQR": 1, "LQI": 0, "ideal": 0}
    assert numbers["trials"].to_dict() == {"LQR": 2, "LQI": 3, "ideal": 3}
    assert numbers["experiments"].to_dict() == {"LQR": 2.5, "LQI": 3.0, "ideal": 3.0}
    assert numbers["mean_share"].to_dict() == pytest.approx({"LQR": 0.0, "LQI": 1 / 3, "ideal": 1.0})
    assert numbers["better LQI"].dropna().to_dict() == pytest.approx({"LQR": 1 / 6, "ideal": 1.0})
    assert numbers.loc["ideal", "p LQI"] == pytest.approx(2 * 2 * 0.5**3)  # three pairs of two tests
    assert numbers.loc["ideal", "holds_low"] == wilson(3, 3).low
    copies = Comparison("method", ["LQI"]).draw(made_up(texts, "that of all"), ()).numbers
    assert copies["p LQI"].isna().all()
    assert copies.set_index("method").loc["ideal", "holds_low"] == wilson(1, 1).low
    lasts = "the last policy lasts for the task's horizon without a failure, long ones to their end"
    assert lasts in picture.caption
    assert picture.caption.endswith(
        " Policies hold most often with ideal 3 of 3 (44% to 100%); Wilson intervals are over different "
        "policies. p in the table: sign tests against LQI, Holm-corrected."
    )
    picture_of_two = Comparison("method").draw(made_up({"ideal": [half, all_of_16, all_of_16]}), ())
    (curve,) = picture_of_two.figure.axes[-1].lines
    assert np.asarray(curve.get_ydata()).tolist() == pytest.approx([0, 1 / 3, 2 / 3, 2 / 3])  # of all trials
    two = made_up({"LQI": [half, all_of_16, fallen]})
    five = pd.concat([two.table.assign(method=str(i)) for i in range(5)])
    alike = Comparison("method").draw(replace(two, table=five), ())
    assert alike.numbers["share_low"].isna().all()
    assert "bootstrap" not in alike.caption
    six = pd.concat(
        [two.table.assign(repetition=3 * i + two.table["repetition"], hash=str(i)) for i in range(2)]
    )
    of_policies = Comparison("method").draw(replace(two, table=six.assign(policy=list("abcdef"))), ())
    assert of_policies.numbers["share_low"].item() < 0.5 < of_policies.numbers["share_high"].item()
    good, bad = (six.assign(test_episodes=each, lasting_episodes="") for each in (all_of_16, fallen))
    mostly = pd.concat([bad, bad, *[good] * 6])
    policies = [*map(str, range(12)), *["a"] * 36]
    mostly = mostly.assign(policy=policies, repetition=range(48))
    own = Comparison("method").draw(replace(two, table=mostly), ()).numbers.iloc[0]
    assert (
        own["share_low"] < own["share"] == own["share_high"] == 1.0
    )  # policies are resampled with all trials
    assert "with its 95% bootstrap interval over different policies. Below" in of_policies.caption
    for axes in alike.figure.axes[-2:]:
        one, *others = (line.get_transform().transform(line.get_xydata()) for line in axes.lines)
        below = [((one - other) * 72 / alike.figure.dpi)[0, 1] for other in others]
        assert below == pytest.approx([1.6, 3.2, 4.8, 4.8])  # pt, about a line's width, and not too far
    none = Comparison("method").draw(made_up({"LQI": [fallen] * 3}), ())
    assert none.caption.endswith(" No trial ends with a policy that holds.")
    tie = Comparison("method").draw(made_up({"LQI": [all_of_16, "-", "-"], "ideal": [all_of_16] * 3}), ())
    assert (
        "hold equally often with LQI 1 of 1 (21% to 100%), ideal 3 of 3 (44% to 100%); Wilson" in tie.caption
    )
    raised = Comparison("method").draw(made_up({"LQI": [all_of_16, "", ""], "ideal": [all_of_16] * 3}), ())
    assert "hold most often with ideal 3 of 3 (44% to 100%); Wilson" in raised.caption  # of LQI 1 of 1
    labels = [text.get_text() for text in raised.figure.axes[0].get_yticklabels()]
    assert labels == ["LQI, 2 raised", "ideal"]
    only = Comparison("method").draw(made_up({"LQI": [all_of_16, "", ""]}), ())
    assert "with LQI 1 of 1 (21% to 100%, 2 raised); Wilson" in only.caption
    crashed = Comparison("method", ["LQR"]).draw(made_up({"LQR": [""] * 3, "ideal": [half] * 3}), ())
    assert crashed.numbers["method"].tolist() == ["ideal"]
    assert crashed.caption.endswith(" All trials of LQR are left out.")
    assert "sign tests" not in Comparison("method", ["LQI"]).draw(made_up({"LQI": [half] * 3}), ()).caption
    later = {"LQI": ["-", all_of_16, all_of_16], "ideal": ["-", "1" * 15, all_of_16], "LQR": ["1" * 15] * 3}
    partly = Comparison("method", ["LQI", "LQR"]).draw(made_up(later), ())
    numbers = partly.numbers.set_index("method")
    assert numbers["mean_share"].tolist() == [1.0] * 3
    counts = numbers[["trials", "raised", "judged", "holds"]]
    assert counts.to_numpy().tolist() == [[3, 0, 0, 0], [2, 0, 2, 2], [2, 0, 1, 1]]
    assert numbers[["p LQI", "p LQR"]].isna().all(axis=None)
    assert "takes 16 test episodes: 4 trials have fewer and do not count" in partly.caption
    assert partly.caption.endswith(" 2 trials ended without a test and are left out.")
    for fewer in (["1" * 10] * 3, ["1" * 10, "1" * 10, ""]):  # also if a trial raised
        short = Comparison("method").draw(made_up({"LQI": fewer}), ())
        assert short.numbers[["holds_low", "holds_high"]].isna().all(axis=None)
        assert short.caption.endswith("one below the other.")
    alone = replace(made_up(texts), sweep=replace(sweep, axes=sweep.axes[1:]))  # no axis beside the methods
    pd.testing.assert_frame_equal(Comparison("method", ["LQI"]).draw(alone, ()).numbers, picture.numbers)
    easy = made_up({"LQI": ["1" * 15 + "0"] * 3, "ideal": [all_of_16] * 3})
    hard = made_up({"LQI": [fallen] * 3, "ideal": ["1" * 55 + "0" * 5] * 3})
    tables = [each.table.assign(cell=str(i)) for i, each in enumerate([easy, *[hard] * 5])]
    six = pd.concat(tables).sort_values("repetition", kind="stable")
    for table in (six, six[1:]):  # without the first trial, cells of LQI are in another order
        picture = Comparison("method", ["LQI"]).draw(replace(easy, table=table), ())
        counted = picture.numbers.set_index("method").loc["ideal", ["holds_low", "better LQI", "p LQI"]]
        assert counted.tolist() == pytest.approx([wilson(6, 6).low, 1.0, 2 * 0.5**6])  # cells, not trials
    ten = pd.concat([hard.table[:1].assign(method=str(i)) for i in range(10)])
    eight = Comparison("method").draw(replace(hard, table=ten), ())
    assert eight.caption.endswith(" Curves are of 8 of 10 methods.")
    with pytest.raises(FigureError, match="no trial of the sweep ran to an end"):
        Comparison("method").draw(made_up({"LQI": [""] * 3}), ())
    untested = made_up({"LQI": [half] * 3})
    untested.table["test_episodes"] = ""
    with pytest.raises(FigureError, match=r"run them with policy_test\.episodes=20 tracking\.trials="):
        Comparison("method").draw(untested, ())
    with pytest.raises(FigureError, match="no such axis or point: method, LQX"):
        Comparison("method", ["LQX"]).draw(made_up({"LQI": ["1"] * 3}), ())
    fewer = made_up({"LQI": ["1"] * 3})
    axes = [replace(axis, left_out=("LQX",)) if axis.name == "method" else axis for axis in sweep.axes]
    Comparison("method", ["LQX"]).draw(replace(fewer, sweep=replace(sweep, axes=tuple(axes))), ())


def test_last_policies_are_dots_that_no_other_hides() -> None:
    """On the left by their experiments, on the right by their share of all starts; a row for each cell."""
    sweep = expand(["+sweep=gaps"])
    raised = {"gap": "lag 20 ms", "repetition": 0, "outcome": "error", "experiments": 1, "test_episodes": ""}

    def made_up(starts: dict[str, list[str]]) -> SweptTrials:
        rows = [
            {"gap": gap, "repetition": i, "outcome": "succeeded" if i else "not succeeded"}
            | {"experiments": 4 + i, "test_episodes": text}
            for gap, texts in starts.items()
            for i, text in enumerate(texts)
        ]
        return swept(sweep, [*rows, raised])

    starts = {"slope 0.02 rad": ["1111", "1100"], "slope 0.05 rad": ["0000", "111111", ""]}
    picture = LastPolicies().draw(made_up(starts), ())
    assert picture.numbers["success_rate"].tolist() == pytest.approx([1, 1 / 2, 0, 1])
    assert picture.numbers["experiments"].tolist() == [4, 5, 4, 5]
    shown = ("of 4 to 6 test episodes", "2 of 4 trials end", "in 0 of 2 cells")
    shown += (" 1 trial ended without a test and is left out.",)
    for words in ("experiments until success, without it all", "lasts for the task's horizon", *shown):
        assert words in picture.caption
    with pytest.raises(FigureError, match=r"policy_test\.episodes=20"):
        LastPolicies().draw(made_up({"slope 0.02 rad": ["", ""]}), ())
    figure = LastPolicies().draw(made_up({"slope 0.02 rad": ["1111"] * 10}), ()).figure
    assert_nothing_is_cut(figure)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["trial that succeeds", "trial that never does", "mean", "90% of episodes"]
    left, right = figure.axes
    assert len(left.get_yticklabels()) == 24
    assert left.get_xlim()[1] > 13  # the most experiments of a trial, 5 above the mean
    dots: Any = [(some, at) for some in right.collections[1:] for at in some.get_offsets()]  # type: ignore[union-attr]
    assert all(abs(height) < 0.5 for _, (_, height) in dots)
    places = [some.get_offset_transform().transform(at) * 72 / figure.dpi for some, at in dots]
    assert len(places) == 10
    assert min(np.hypot(*(a - b)) for a, b in itertools.combinations(places, 2)) > 3.2  # pt, of a dot


def test_figures_fit_a_column_of_a_paper() -> None:
    sweep = expand(["+sweep=gaps", f"+sweep.figures_width={COLUMN}"])
    trials = swept(sweep, results.published(sweep).to_dict("records"))  # type: ignore[arg-type]
    for figure in (sweep.figures["gaps"], Experiments(COLUMN)):
        made = figure.draw(trials, ()).figure
        assert made.get_figwidth() == COLUMN
        made.draw_without_rendering()
        boxes = [axes.xaxis.label.get_window_extent() for axes in made.axes]
        assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))
        assert all(box.x0 >= 0 and box.x1 <= made.bbox.width for box in boxes)
        assert {text.get_fontsize() for axes in made.axes for text in axes.get_xticklabels()} == {8.0}
    for width, words in (("1", "greater than or equal to 3.2"), ("wide", "number")):
        with one_line(f"^sweep.figures_width: .*{words}"):
            expand(["+sweep=gaps", f"+sweep.figures_width={width}"])


@pytest.mark.filterwarnings("error")
def test_labels_may_be_long_and_cells_alike_when_joined() -> None:
    points = "{no noise: {hardware.inertia_error: 0.1}, no $_$: {hardware.inertia_error: 0.2}}"
    long = "so much more $_$ " * 8
    others = f"{{learned: {{bias: gp}}, noise learned: {{bias: none}}, {long}: {{bias: mean}}}}"
    sweep = expand([f"+sweep={{trials: 1, axes: {{a: {{points: {points}}}, b: {{points: {others}}}}}}}"])
    ended = {"repetition": 0, "iterations": 1, "experiments": 2, **LATER, "test_episodes": "1111"}
    rows = [
        {**dict(zip("ab", cell.labels, strict=True)), "hash": str(i), "outcome": "succeeded", **ended}
        for i, cell in enumerate(sweep.cells)
    ]
    trials = swept(sweep, [{**row, "lasting_episodes": "1111"} for row in rows])
    last = LastPolicies().draw(trials, ())
    assert "nine in ten trials do in 6 of 6 cells" in last.caption
    drawn = [figure.draw(trials, ()) for figure in (Experiments(), Comparison("a"))]
    drawn += [figure.draw(trials, ()) for figure in (LastPolicies(COLUMN), Experiments(COLUMN))]
    for picture in (last, *drawn):
        picture.figure.draw_without_rendering()
        boxes = [axes.get_tightbbox() for axes in picture.figure.axes]  # with their labels
        assert all(box and box.x0 >= 0 and box.x1 <= picture.figure.bbox.width for box in boxes)
    with pytest.raises(FigureError, match="no trial of the sweep ran to an end"):
        Experiments().draw(swept(sweep, [{**row, "outcome": "error"} for row in rows]), ())


def test_legends_and_rows_name_their_axes() -> None:
    """Also by labels that begin with an underscore, and cells in words."""
    several = "x: {keys: [bias.d, hardware.inertia_error], values: [[2.0, 0.1]]}"
    learners = ("acceleration_residual", "permuted_gp_learned", "gp")
    axes = f"{{bias: [{', '.join(learners)}], evaluation: [nominal_start, domain_randomization], {several}}}"
    sweep = expand([f"+sweep={{trials: 1, axes: {axes}}}"])
    ended = {"outcome": "succeeded", "experiments": 2, "iterations": 2, **LATER}
    rows = [
        {**dict(zip(("bias", "evaluation", "x"), cell.labels, strict=True)), **ended} for cell in sweep.cells
    ]
    raised = [{**row, "outcome": "error"} for row in rows[:2]]
    texts = Experiments().draw(swept(sweep, [*rows[1:], *raised]), ()).figure.axes[0].texts
    assert [text.get_text() for text in texts] == ["0/0, 1 raised", "1/1, 1 raised"]
    figure = Experiments().draw(swept(sweep, rows), ()).figure
    (axes,), (legend,) = figure.axes, figure.legends
    assert legend.get_title().get_text() == "evaluation, d/inertia error"
    assert legend.get_texts()[0].get_text() == "nominal_start, 2/0.1"
    assert [each.get_text() for each in axes.get_yticklabels()] == list(learners)
    assert sweep.words(("gp", "nominal_start", "2/0.1")) == "gp, nominal_start, x 2/0.1"
    points = "{_short: {task.horizon: 100}, _long: {task.horizon: 200}}"
    hidden = expand([f"+sweep={{trials: 1, axes: {{bias: [gp, none], of: {{points: {points}}}}}}}"])
    rows = [{**dict(zip(("bias", "of"), cell.labels, strict=True)), **ended} for cell in hidden.cells]
    (legend,) = Experiments().draw(swept(hidden, rows), ()).figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [r"$\_$short", r"$\_$long"]
    keys = "keys: [bias.d, bias.noise_variance]"
    for gap, ticks, name in (
        ("{points: {1 N m/rad: {bias.d: 2.0, bias.noise_variance: 0.5}}}", "1 N m/rad", "gap"),
        (f"{{{keys}, values: [[2.0, 0.5]], labels: [1 N m/rad]}}", "1 N m/rad", "gap"),
        (f"{{{keys}, values: [[2.0, 0.5]]}}", "2, 0.5", "d, noise variance"),
    ):
        sweep = expand([f"+sweep={{trials: 1, axes: {{gap: {gap}}}}}"])
        trials = swept(sweep, [{"gap": sweep.axes[0].labels[0], **ended}])
        (axes,) = Experiments().draw(trials, ()).figure.axes
        assert ([each.get_text() for each in axes.get_yticklabels()], axes.get_ylabel()) == ([ticks], name)


def test_eight_series_are_told_from_each_other() -> None:
    """Of costs, there is a panel for each cell, in rows; legends are whole."""
    axes = f"{{hardware.inertia_error: [0.0, 0.05], bias: {LEARNERS}, evaluation: {EVALUATIONS}}}"
    sweep = expand([f"+sweep={{trials: 3, axes: {axes}}}"])
    labels = [dict(zip((axis.name for axis in sweep.axes), cell.labels, strict=True)) for cell in sweep.cells]
    rows = [
        {**cell, "outcome": "succeeded", "experiments": repetition % 3 + 2, "iterations": 3, **LATER}
        for cell in labels
        for repetition in range(12)
    ]
    rows[0]["outcome"] = rows[12]["outcome"] = "not succeeded"  # 11/12 beside both
    figure = Experiments().draw(swept(sweep, rows), ()).figure
    assert_nothing_is_cut(figure)
    one, other = (text.get_window_extent() for text in figure.axes[0].texts)
    assert not one.overlaps(other)
    points = [container.lines[0] for container in figure.axes[0].containers]
    assert len({to_hex(line.get_color()) for line in points}) == 8
    assert len({line.get_marker() for line in points}) == 8
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == [f"{bias}, {evaluation}" for bias, evaluation in itertools.product(LEARNERS, EVALUATIONS)]

    def trial(hash_: str) -> SimpleNamespace:
        costs = [(index, 10.0 ** (index + 1), hash_ == "0" and index == 2) for index in range(3)]
        names = ("index", "hardware_cost", "succeeded")
        iterations = [dict(zip(names, each, strict=True), total_experiments=each[0] + 1) for each in costs]
        return SimpleNamespace(
            study=SimpleNamespace(
                cost=SimpleNamespace(max_cost=100.0 * (1 + int(hash_) // 2)),
                task=SimpleNamespace(says_success=False),
            ),
            iterations=[SimpleNamespace(**each, search=None) for each in iterations],
        )

    for cells in (1, 8):
        rows = [
            {**labels[cell], "hash": str(2 * cell + i), "repetition": i, "seed": i, "outcome": "succeeded"}
            for cell in range(cells)
            for i in range(2)
        ]
        figure = Costs().draw(swept(sweep, rows, trial), ()).figure
        assert_nothing_is_cut(figure)
        assert sum(bool(axes.lines) for axes in figure.axes) == cells
        shaded = [axes.patches[0] for axes in figure.axes[:cells]]
        assert [each.get_y() for each in shaded] == [100.0 * (1 + cell) for cell in range(cells)]
        data = (line.zorder for axes in figure.axes for line in axes.lines[:-1])
        assert max(text.zorder for axes in figure.axes for text in axes.texts) < min(data)
        top = figure.axes[0].get_ylim()[1]
        assert all(each.get_y() + each.get_height() >= 0.99 * top for each in shaded)
        assert figure.get_figwidth() < 15.0
        assert figure.axes[cells - 1].get_xlabel() == "iteration (trials side by side)"


def test_maps_of_many_cells_are_in_rows() -> None:
    """Their titles do not overlap, and rates of one policy stand above their tick, on an axis up to 1."""
    points = ", ".join(f"{'much noise ' * 6}{n}: {{hardware.inertia_error: 0.{n}}}" for n in range(1, 7))
    sweep = expand([f"+sweep={{trials: 1, axes: {{noise: {{points: {{{points}}}}}}}}}"])
    labels = sweep.axes[0].labels
    ranges = Range("alpha_w", -0.1, 0.1, 2), Range("alpha_b", -0.1, 0.1, 2)
    rates = SuccessRates(build(sweep.base).task, sweep.cells, *ranges, 1, labels[0])
    rows = [{"noise": label, "repetition": 0, "outcome": "succeeded"} for label in labels]
    outcomes = [Outcomes((), (), (), (True,) * 4)] * 6
    figure = rates.draw(swept(sweep, rows), outcomes).figure
    figure.draw_without_rendering()
    *maps, aside = (axes for axes in figure.axes if axes.get_title())
    titles = [axes.title.get_window_extent() for axes in (*maps, aside)]
    ticks = [tick.get_window_extent() for tick in aside.get_xticklabels()]
    for texts in (titles, ticks):
        assert not any(one.overlaps(other) for one, other in itertools.combinations(texts, 2))
    assert len(maps) == len(ticks) == 6
    assert figure.get_figwidth() < 12.0
    assert [line.get_xdata()[0] for line in aside.lines if line.get_marker() == "o"] == [*range(6)]
    assert max(aside.get_yticks()) == 1.0
    two = SuccessRates(build(sweep.base).task, sweep.cells, *ranges, 2, labels[0])
    copies = two.draw(swept(sweep, rows), [outcomes[0]] * 12)
    assert set(copies.numbers["experiments"]) == {1}
    assert "from each start, where those with one policy are all alike" in copies.caption


def test_labels_longer_than_the_figure_are_wrapped() -> None:
    labels = ["short", "a series whose name is far too long " * 4]
    figure = Figure(figsize=(4.0, 3.0), layout="constrained")
    legend(figure, {label: figure.add_subplot().plot([0, 1])[0] for label in labels})
    assert_nothing_is_cut(figure)
