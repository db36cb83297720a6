"""MLflow's UI as a person meets it: the command and the address that a sweep prints, in a real browser.

With SCREENSHOTS=folder in the environment a longer sweep runs, and README's pictures are made there.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from mlflow_ui import CHROMIUM, browse, serve, visit
from PIL import Image
from playwright.sync_api import Locator, Page, expect
from processes import wait_for
from sweeping import QUICK, run

FOLDER = os.environ.get("SCREENSHOTS")
if FOLDER:
    SWEEP = ["+sweep=learners", "sweep.axes.bias=[gp,none]", "sweep.trials=1"]
    NAME, TRIALS = "sweep learners", 8
    AXES = ("hardware.noise.torque_variance", "hardware.inertia_error", "bias")
    CHARTED = re.compile("gp #0$")
else:
    SWEEP = ["+sweep=smoke", *QUICK, "cost.max_cost=1e-3", "sweep.trials=1", "engine=sequential"]
    NAME, TRIALS = "sweep smoke", 2  # of two iterations each
    AXES = ("hardware.inertia_error",)
    CHARTED = re.compile("#0$")
TRIAL = re.compile(r"#\d$")  # how the names of trials end

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]


class Site(NamedTuple):
    """A server that shows a store."""

    root: str
    printed: str  # the address that the sweep printed, on this server's port


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """The command that the sweep printed, run."""
    folder = tmp_path_factory.mktemp("swept")
    status, out, err = run(*SWEEP, folder=folder, timeout=3600 if FOLDER else 300)
    assert status == 0, err
    found = re.search(r"^Look at it:  (.*)$", out, re.MULTILINE)
    assert found, out
    with serve(found[1], folder) as root:
        log = folder / "server.log"
        wait_for(lambda: "Ctrl-C" in log.read_text())
        yield Site(root, log.read_text().split()[0])


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """One for all: what it has loaded, it need not load again."""
    with browse() as browser, visit(browser) as page:
        yield page


def links(page: Page, name: str | re.Pattern[str]) -> Locator:
    """The runs of MLflow's list that have this name."""
    return page.get_by_role("gridcell").get_by_role("link", name=name, exact=True)


def is_shown(picture: Locator) -> None:
    """A picture has arrived and could be decoded."""
    expect(picture).to_be_visible()
    expect(picture).to_have_js_property("complete", True)
    assert picture.evaluate("image => image.naturalWidth") > 300


def screenshot(page: Page, name: str) -> None:
    """Keep what is seen, in few colours."""
    if FOLDER:
        path = Path(FOLDER, f"{name}.png")
        page.screenshot(path=path, animations="disabled")
        Image.open(path).convert("RGB").quantize().save(path, optimize=True)


def test_the_printed_address_shows_the_sweep_with_table_and_figure(site: Site, page: Page) -> None:
    """In MLflow's list it unfolds into its trials."""
    page.goto(site.printed)
    expect(page.get_by_role("heading", name=NAME)).to_be_visible()
    expect(page.get_by_role("main").get_by_role("link", name="Runs")).to_be_visible()  # not "Evaluations"
    done = f"Done: {TRIALS} of {TRIALS} trials."
    expect(page.get_by_role("paragraph").filter(has_text=done)).to_be_visible()
    expect(page.get_by_role("columnheader", name=re.compile("experiments$")).first).to_be_visible()
    expect(page.get_by_role("link", name="experiments/mean")).to_be_visible()
    page.get_by_role("button", name="Expand description").click()
    with page.context.expect_page() as opened:
        page.get_by_role("paragraph").get_by_role("link", name="experiments", exact=True).click()
    is_shown(opened.value.get_by_role("img", name="experiments.png"))
    opened.value.close()
    page.goto(f"{site.root}/#/experiments/1/runs?workflowType=machine_learning")
    sweep = page.get_by_role("gridcell").filter(has=page.get_by_role("link", name=NAME, exact=True))
    expect(sweep).to_have_count(1)
    expect(links(page, TRIAL)).to_have_count(0)
    sweep.get_by_role("button").click()
    expect(links(page, TRIAL)).to_have_count(TRIALS)


def test_trials_are_listed_fewest_experiments_first_and_show_charts_and_pictures(
    site: Site, page: Page
) -> None:
    """By the axes; charts stand in sections."""
    page.goto(site.printed)
    with page.context.expect_page() as opened:
        page.get_by_role("paragraph").get_by_role("link", name="trials", exact=True).click()
    trial = opened.value
    expect(links(trial, TRIAL)).to_have_count(TRIALS)
    for head in ("experiments/total", "outcome", *AXES):
        expect(trial.get_by_role("columnheader", name=head).first).to_be_visible()
    column = trial.locator("[role=gridcell][col-id='metrics.`experiments/total`']")
    expect(column).to_have_count(TRIALS)
    found = list(map(int, column.all_inner_texts()))
    assert found == sorted(found)
    assert min(found) >= 2
    screenshot(trial, "mlflow_trials")
    links(trial, CHARTED).last.click()  # that with most experiments
    expect(trial.get_by_role("heading", name=CHARTED)).to_be_visible()
    trial.goto(f"{trial.url}?workflowType=machine_learning")  # as printed for a trial; MLflow's links lose it
    trial.get_by_role("tab", name="Model metrics").click()
    for section in ("cost", "data", "experiments", "seconds"):
        head = re.compile(rf"^{section}\s*\(\d+\)")
        expect(trial.get_by_role("figure").filter(has_text=head)).to_be_attached()
    expect(trial.get_by_role("heading", name="hardware_max")).to_be_visible()
    expect(trial.locator(".scatterlayer .point").nth(1)).to_be_visible()  # a curve has two points at least
    screenshot(trial, "mlflow_charts")
    trial.get_by_role("tab", name="Artifacts").click()
    trial.get_by_text("pictures", exact=True).click()
    trial.get_by_text("overview.png", exact=True).click()
    is_shown(trial.get_by_role("img", name="overview.png"))
