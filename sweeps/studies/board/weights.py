"""Numbers of published policies, read without unpickling: no code of a file ever runs."""

from __future__ import annotations

import io
import pickletools
import zipfile
from pathlib import Path

import numpy as np

from simbias.core.records import Array

FEATURES = 6  # of MC-PILCO's basis functions: both velocities, cosines and sines
SHORTEST = 8 * FEATURES  # bytes of an array; what is shorter is no number of a policy


def of_basis_functions(file: Path) -> list[tuple[Array, Array, Array]]:
    """Length scales (6,), centres (k, 6) over them, and weights (k,), of the policy of each joint."""
    found = [
        np.frombuffer(value) for _, value, _ in pickletools.genops(file.read_bytes()) if _is_array(value)
    ]
    policies = []
    for logarithms, centres, weights in zip(*[iter(found)] * 3, strict=True):
        scales = np.exp(logarithms)
        policies.append((scales, centres.reshape(-1, FEATURES) / scales, weights))
    return policies


def of_network(file: Path, layers: list[str]) -> list[tuple[Array, Array]]:
    """Weights (in, out) and biases (out,) of the named layers of a network that PyTorch saved."""
    archive = zipfile.ZipFile(io.BytesIO(zipfile.ZipFile(file).read("policy.pth")))
    root = archive.namelist()[0].split("/")[0]
    tensors, name = dict[str, Array](), ""
    for operation, value, _ in pickletools.genops(archive.read(f"{root}/data.pkl")):
        if operation.name != "BINUNICODE":
            continue
        if value.endswith((".weight", ".bias")):
            name = value
        elif value.isdigit() and name:  # the first storage behind a name is its tensor's
            tensors[name] = np.frombuffer(archive.read(f"{root}/data/{value}"), np.float32)
            name = ""
    sized = [(tensors[f"{layer}.weight"], tensors[f"{layer}.bias"]) for layer in layers]
    return [(weights.reshape(len(biases), -1).T, biases) for weights, biases in sized]


def _is_array(value: object) -> bool:
    return isinstance(value, bytes) and len(value) >= SHORTEST
