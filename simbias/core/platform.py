"""What the last bits of a result depend on beside its config and the code: processor and linear algebra."""

from __future__ import annotations

import platform
from contextlib import suppress
from functools import cache
from pathlib import Path

# Vector instructions by which sums are ordered, and fused products: another set, other last bits.
FEATURES = ("fma", "avx", "avx2", "avx512f", "neon", "sve")


@cache
def kind() -> str:
    """The processor that code is compiled for and its kernels of linear algebra, in one line.

    On machines of one kind, the same trial has the same bits. It is what Numba, NumPy and OpenBLAS found, so
    also what NUMBA_CPU_NAME or OPENBLAS_CORETYPE made of it.
    """
    import numpy as np
    import scipy.linalg  # noqa: F401  (brings a BLAS of its own)
    from numba.core.registry import cpu_target
    from threadpoolctl import threadpool_info

    _, name, features = cpu_target.target_context.codegen().magic_tuple()
    with_features = [each for each in FEATURES if f"+{each}" in features.split(",")]
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    libraries = sorted(
        {
            " ".join(str(info.get(key) or "") for key in ("internal_api", "version", "architecture")).strip()
            for info in threadpool_info()
            if info["user_api"] == "blas"
        }
    )
    parts = [" ".join([name, *with_features]), " ".join(["NumPy", *found]), *libraries]
    return f"{platform.machine()}: {', '.join(parts)}"


@cache
def processor() -> str:
    """The processor's model, as the system names it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
