"""What runs in a sweep's workers."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import sys
from simbias.config import compose
from simbias.worker import run_plan

trial = compose(["task.horizon=100", "optimizer.max_evaluations=20", "method.max_iterations=1"]).trial
record = run_plan((trial.config, trial.choices))
assert record.error is None and record.pictures, record
print(*{"pandas", "pyarrow", "mlflow", "rich"} & set(sys.modules))
"""


def test_a_worker_does_without_what_only_the_parent_needs() -> None:
    """It saves a quarter of its memory."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert done.stdout == "\n", done.stderr
