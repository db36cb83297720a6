"""MLflow's UI as a person meets it: the command and the address that a sweep prints, in a real browser.

With SCREENSHOTS=folder in the environment a longer sweep runs, and README's pictures are made there.
"""

import os
import re
import shlex
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urljoin

import pytest
from mlflow_ui import CHROMIUM, browse, visit
from PIL import Image
from playwright.sync_api import Locator, Page, expect
from sweeping import QUICK, run, start

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


@pytest.fixture
def page(new_store: Path, tmp_path: Path) -> Iterator[Page]:
    """The page at the address that the command prints which the sweep printed."""
    shutil.copy(new_store, tmp_path)
    status, out, err = run(*SWEEP, folder=tmp_path, timeout=3600 if FOLDER else 300)
    assert status == 0, err
    found = re.search(r"^Look at it:  (.*)$", out, re.MULTILINE)
    assert found, out
    python, *program, command, name = shlex.split(found[1])
    assert (python, program) == (sys.executable, ["-m", "simbias"])
    server = start(command, name, folder=tmp_path)
    try:
        with browse() as browser, visit(browser) as page:  # while the server starts
            assert server.stdout is not None
            page.goto(server.stdout.readline().split()[0])
            yield page
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()


def follow(page: Page, link: str) -> None:
    """To where a link of a note leads, without a new tab, which loads all of MLflow's UI again."""
    address = page.get_by_role("paragraph").get_by_role("link", name=link, exact=True).get_attribute("href")
    assert address is not None
    page.goto(urljoin(page.url, address))


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


def test_the_printed_address_shows_the_sweep_and_its_trials(page: Page) -> None:
    """With table and figure; in MLflow's list it unfolds.

    Trials are listed by their axes, fewest experiments first, and have charts and pictures.
    """
    printed = page.url
    expect(page.get_by_role("heading", name=NAME)).to_be_visible()
    expect(page.get_by_role("main").get_by_role("link", name="Runs")).to_be_visible()  # not "Evaluations"
    done = f"Done: {TRIALS} of {TRIALS} trials."
    expect(page.get_by_role("paragraph").filter(has_text=done)).to_be_visible()
    expect(page.get_by_role("columnheader", name=re.compile("experiments$")).first).to_be_visible()
    expect(page.get_by_role("link", name="experiments/mean")).to_be_visible()
    page.get_by_role("button", name="Expand description").click()
    follow(page, "experiments")
    is_shown(page.get_by_role("img", name="experiments.png"))
    page.goto(printed)
    follow(page, "trials")
    expect(links(page, TRIAL)).to_have_count(TRIALS)
    for head in ("trial/experiments", "outcome", *AXES):
        expect(page.get_by_role("columnheader", name=head).first).to_be_visible()
    column = page.locator("[role=gridcell][col-id='metrics.`trial/experiments`']")
    expect(column).to_have_count(TRIALS)
    found = list(map(int, column.all_inner_texts()))
    assert found == sorted(found)
    assert min(found) >= 2
    screenshot(page, "mlflow_trials")
    links(page, CHARTED).last.click()  # that with most experiments
    expect(page.get_by_role("heading", name=CHARTED)).to_be_visible()
    page.goto(f"{page.url}?workflowType=machine_learning")  # as printed for a trial; MLflow's links lose it
    page.get_by_role("tab", name="Model metrics").click()
    for section in ("cost", "data", "experiments", "seconds"):
        head = re.compile(rf"^{section}\s*\(\d+\)")
        expect(page.get_by_role("figure").filter(has_text=head)).to_be_attached()
    expect(page.get_by_role("heading", name="hardware_max")).to_be_visible()
    expect(page.locator(".scatterlayer .point").nth(1)).to_be_visible()  # a curve has two points at least
    screenshot(page, "mlflow_charts")
    page.get_by_role("tab", name="Artifacts").click()
    page.get_by_text("pictures", exact=True).click()
    page.get_by_text("overview.png", exact=True).click()
    is_shown(page.get_by_role("img", name="overview.png"))
    page.goto(f"{printed.partition('/runs/')[0]}/runs?workflowType=machine_learning")
    sweep = page.get_by_role("gridcell").filter(has=page.get_by_role("link", name=NAME, exact=True))
    expect(sweep).to_have_count(1)
    expect(links(page, TRIAL)).to_have_count(0)
    sweep.get_by_role("button").click()
    expect(links(page, TRIAL)).to_have_count(TRIALS)
