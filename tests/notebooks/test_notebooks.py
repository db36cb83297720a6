"""The notebooks run from top to bottom, in a folder of their own, and are kept without outputs."""

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from conftest import ROOT
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell

pytestmark = pytest.mark.slow

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
PICTURES = {"1_first_steps": 3, "2_results": 4, "3_own_component": 0, "4_a_lab": 0, "5_from_mjcf": 1}
QUICK = '"task.horizon=200", "optimizer.max_evaluations=20"'
SHORTER = {
    '["seed=0"]': f'[{QUICK}, "method.max_iterations=2", "cost.max_cost=1e-3"]',  # two iterations
    "times=[0, 0.5, 1, 2, 4]": "times=[0, 0.1]",
    "range(10)": "range(2)",
    '"task.horizon=1000"': f'{QUICK}, "method.max_iterations=1", "tracking.pictures=false"',
    '"task.horizon=2000"': '"task.horizon=200"',
    '"method.max_iterations=3"': '"method.max_iterations=1"',
    '"evaluation=domain_randomization"': '"evaluation=domain_randomization", "optimizer.max_evaluations=20"',
    "max_evaluations: 200": "max_evaluations: 20",
    "optimizer.max_evaluations=200": "optimizer.max_evaluations=20",
    "horizon: 200 ": "horizon: 40 ",
    "hold: 1.0": "hold: 0.4",
    "preset=pole tracking": "preset=pole method.max_iterations=1 tracking",
}
SECONDS = 300  # a cell, on a busy machine
IN_NUMPY = "5_from_mjcf"  # all commands: two starts and a compiled loop take longer than what they do
COMMAND = re.compile(r"^!\{python\} -m simbias (.*) \| cat$", re.MULTILINE)
STATUSES = [0, 1]  # the contracts hold; a trial of a single iteration does not succeed
BEGIN = f"""
import sys
sys.path.insert(0, {str(ROOT / "tests" / "support")!r})
import pytest
from in_numpy import predict_in_numpy, simulate_in_numpy
from simbias.__main__ import main
patch = pytest.MonkeyPatch()
simulate_in_numpy(patch)
predict_in_numpy(patch)
"""


@pytest.fixture(scope="module")
def kernel() -> Iterator[AsyncKernelManager]:
    """One kernel for all, which has imported simbias once; each notebook finds it without names."""
    manager = AsyncKernelManager(kernel_name="python3")
    yield manager
    asyncio.run(manager.shutdown_kernel(now=True))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, kernel: AsyncKernelManager, tmp_path: Path) -> None:
    assert [each.stem for each in NOTEBOOKS] == list(PICTURES)
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)
    for cell in cells:
        for text, shorter in SHORTER.items():
            cell.source = cell.source.replace(text, shorter)
    notebook.cells.insert(0, new_code_cell(f"%reset -f\n%cd -q {tmp_path}"))
    if path.stem == IN_NUMPY:
        for cell in cells:
            cell.source = COMMAND.sub(r"main('\1'.split())", cell.source)
        notebook.cells.insert(1, new_code_cell(BEGIN))
        notebook.cells.append(new_code_cell("patch.undo()"))  # others have the same kernel
    NotebookClient(notebook, km=kernel, timeout=SECONDS, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output.get("data", {}) for cell in cells for output in cell.outputs]
    assert sum("image/png" in data for data in shown) == PICTURES[path.stem]
    if path.stem == IN_NUMPY:
        returned = [
            cell.outputs[-1]["data"]["text/plain"] for cell in cells if cell.source.startswith("main(")
        ]
        assert returned == [*map(str, STATUSES)]
