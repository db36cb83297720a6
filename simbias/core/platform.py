"""The platform that determines a result's last bits: processor, linear algebra, simbias's code."""

from __future__ import annotations

import platform
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from simbias.core.digest import short_digest

# Vector instructions, which determine the order of sums, and fused products: both change the last bits.
FEATURES = ("fma", "avx", "avx2", "avx512f", "neon", "sve")
PACKAGE = Path(__file__).resolve().parent.parent


@cache
def kind() -> str:
    """The processor that code is compiled for and the linear algebra kernels, in one line.

    On machines of one kind, the same trial gives the same bits. The line states what Numba, NumPy and
    OpenBLAS detected, including overrides by NUMBA_CPU_NAME or OPENBLAS_CORETYPE.
    """
    import numpy as np
    import scipy.linalg  # noqa: F401  (it has its own BLAS)
    from threadpoolctl import threadpool_info

    name, features = _target()
    with_features = [each for each in FEATURES if f"+{each}" in features]
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    keys = ("internal_api", "version", "architecture")
    blas = [info for info in threadpool_info() if info["user_api"] == "blas"]
    libraries = sorted({" ".join(str(info.get(key) or "") for key in keys).strip() for info in blas})
    parts = [" ".join([name, *with_features]), " ".join(["NumPy", *found]), *libraries]
    return f"{platform.machine()}: {', '.join(parts)}"


def _target() -> tuple[str, list[str]]:
    """The processor that Numba compiles for, and its features, each with a sign: + present, - absent."""
    import numba
    from llvmlite import binding

    config: Any = numba.config  # set by the environment
    if config.CPU_FEATURES is not None:
        features = config.CPU_FEATURES.split(",")
    else:
        features = binding.get_host_cpu_features().flatten().split(",")
        features = [each for each in features if config.ENABLE_AVX or not each.startswith("+avx")]
    return config.CPU_NAME or binding.get_host_cpu_name(), features


@cache
def processor() -> str:
    """The processor's model, as the system names it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@cache
def package_digest() -> str:
    """A hash of simbias's own code, which identifies its version; caches beside the code are left out."""
    files = sorted(file for file in PACKAGE.rglob("*.py") if "__pycache__" not in file.parts)
    named = [f"{file.relative_to(PACKAGE).as_posix()}\0".encode() + file.read_bytes() for file in files]
    return short_digest(b"".join(named))
