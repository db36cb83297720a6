import gc
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from in_numpy import predict_in_numpy, simulate_in_numpy
from threadpoolctl import threadpool_limits

import simbias
from simbias.core.cache import cache_folder
from simbias.testing.studies import warm_up
from simbias.trial.study import Study

ROOT = Path(__file__).resolve().parent.parent
OWN_CONF = ROOT / "notebooks" / "examples" / "conf"
PYTHONPATH = os.pathsep.join(
    map(str, (ROOT, ROOT / "tests", ROOT / "tests" / "support", ROOT / "notebooks" / "examples"))
)  # of processes that tests start
POINT_MASS = [f"{group.name}=point_mass" for group in sorted(OWN_CONF.iterdir())]
ALL_SLOW = re.compile(r"^pytestmark = \[?\s*pytest\.mark\.slow\b", re.MULTILINE)

MEMORY = Path("/dev/shm")  # as a disk, for which each trial waits some thirty times

os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"  # colouring what nobody reads takes a tenth
if os.access(MEMORY, os.W_OK) and not os.statvfs(MEMORY).f_flag & os.ST_NOEXEC:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))


def pytest_sessionstart() -> None:
    """Keep bytecode: else pytest rewrites 20,000 lines at each start, and each process compiles MLflow."""
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_collection_finish() -> None:
    """Look for cycles more rarely, and not in what has been imported: it took a seventh of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without slow tests, do not import what only they need: MLflow, a browser, a cluster."""
    if config.option.markexpr != "not slow" or collection_path.suffix != ".py":
        return None
    return ALL_SLOW.search(collection_path.read_text(encoding="utf-8")) is not None or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with files of many slow tests, so that none of these is left over at the end."""
    slow: dict[Path, list[bool]] = {}
    for item in items:
        slow.setdefault(item.path, []).append(item.get_closest_marker("slow") is not None)
    items.sort(key=lambda item: -sum(slow[item.path]) / len(slow[item.path]))  # a file stays in one piece


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """Linear algebra on one thread, as in a trial: its threads wait for each other in a busy loop."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def _compiled(request: pytest.FixtureRequest) -> None:
    """Compile for slow tests, so that processes that they start take it from the cache and say nothing.

    Of two processes each compiles one half, and waits for the other's; the one that would wait for longer
    has noise as well.
    """
    if not any(item.get_closest_marker("slow") for item in request.session.items):
        return
    second = os.environ.get("PYTEST_XDIST_WORKER") == "gw1"
    noisy = ["bias=none", "evaluation=robust", "hardware.noise.torque_variance=0.1"]
    for overrides in [["bias=none"], noisy, ["bias=gp"]] if second else [["bias=gp"], ["bias=none"]]:
        with FileLock(cache_folder("closed_loops") / f"tests_{'_'.join(overrides)}.lock"):
            warm_up(simbias.load(["tracking=none", *overrides]))


@pytest.fixture(scope="session")
def new_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with nothing in it, to be copied: creating one takes a second."""
    from simbias.mlflow.store import connect  # lazily: MLflow takes seconds

    file = tmp_path_factory.mktemp("new store") / "mlflow.db"
    connect(f"sqlite:///{file}", "another")
    return file


@pytest.fixture(scope="session")
def study() -> Study:
    """The default study, without a store."""
    return simbias.load(["tracking=none"])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate in NumPy: to compile a robot's loop, or a bias, takes longer than a few short rollouts."""
    simulate_in_numpy(monkeypatch)


@pytest.fixture
def plain_predictions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Predict recordings in NumPy, likewise; `test_open_loop.py` holds compiled predictions to them."""
    predict_in_numpy(monkeypatch)


@pytest.fixture
def point_mass() -> Study:
    """A study of one's own plain components; DIRECT's evaluations are few, for speed."""
    return simbias.load([*POINT_MASS, "tracking=none", "optimizer.max_evaluations=150"], OWN_CONF)


@pytest.fixture
def hasty() -> Study:
    """The same in fewer frames, with searches of 20 policies, where it does not matter which one is found."""
    few = ["task.horizon=50", "optimizer.max_evaluations=20", "tracking=none"]
    return simbias.load([*POINT_MASS, *few], OWN_CONF)
