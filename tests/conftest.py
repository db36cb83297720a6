from __future__ import annotations

from pathlib import Path

import pytest

import simbias
from simbias.study import Study

ROOT = Path(__file__).resolve().parent.parent
OWN_CONF = ROOT / "tests" / "own_conf"
NEEDED = {("hardware", "process"): ["hardware.command=cat"]}  # values without which an option is not built
POINT_MASS = [f"{group.name}=point_mass" for group in sorted(OWN_CONF.iterdir())]


@pytest.fixture(scope="session", autouse=True)
def _compiled(request: pytest.FixtureRequest) -> None:
    """Compile for slow tests, so that processes that they start take it from the cache and say nothing."""
    if not any(item.get_closest_marker("slow") for item in request.session.items):
        return
    for bias in ("gp", "none"):
        simbias.load(["tracking=none", f"bias={bias}"]).warm_up()


@pytest.fixture(scope="session")
def study() -> Study:
    """The default study, without a store."""
    return simbias.load(["tracking=none"])


@pytest.fixture
def point_mass() -> Study:
    """A study of one's own plain components; DIRECT's evaluations are few, for speed."""
    return simbias.load([*POINT_MASS, "tracking=none", "optimizer.max_evaluations=150"], OWN_CONF)
