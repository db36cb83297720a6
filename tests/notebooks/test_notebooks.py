"""The notebooks run from top to bottom, in a folder of their own, and are kept without outputs."""

from __future__ import annotations

import asyncio
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
SHORTER = {
    "horizon: 200 ": "horizon: 60 ",
    "preset=pole tracking": "preset=pole method.max_iterations=2 tracking",
}
SECONDS = 300  # a cell, on a busy machine


def test_every_notebook_is_known() -> None:
    assert {path.stem for path in NOTEBOOKS} == set(PICTURES)


@pytest.fixture(scope="module")
def kernel() -> Iterator[AsyncKernelManager]:
    """One kernel for all, which has imported simbias once; each notebook finds it without names."""
    manager = AsyncKernelManager(kernel_name="python3")
    yield manager
    asyncio.run(manager.shutdown_kernel(now=True))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, kernel: AsyncKernelManager, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)
    for cell in cells:  # of the swing-up that is planned, identified and planned again
        for text, shorter in SHORTER.items():
            cell.source = cell.source.replace(text, shorter)
    notebook.cells.insert(0, new_code_cell(f"%reset -f\n%cd -q {tmp_path}"))
    NotebookClient(notebook, km=kernel, timeout=SECONDS, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output.get("data", {}) for cell in cells for output in cell.outputs]
    assert sum("image/png" in data for data in shown) == PICTURES[path.stem]
