"""Where a trial comes from: versions of packages, the checkout's commit, the user, the user's own code.

A comment is no other trial, so what changed is told, and the user decides whether results still count.
"""

from __future__ import annotations

import getpass
import json
import logging
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from simbias.core.digest import short_digest
from simbias.core.platform import PACKAGE
from simbias.trial.study import Study

TOOLS = re.compile(r"extra == .(docs|test)\b")  # requirements that no trial runs with
IN_CLEAR = "simbias: %s: from the environment, and written in clear into %s, which MLflow shows too"


def description(study: Study) -> dict[str, Any]:
    """A study in JSON's types: identity, config without the store's, versions and code."""
    origin = study.composition
    config = {key: value for key, value in origin.config.items() if key != "tracking"}
    return {
        "hash": study.hash,
        "title": study.title,
        "seed": study.seed,
        "choices": {key: option for key, option in origin.choices.items() if key != "tracking"},
        "config": config,
        "code": digests(study),
        **provenance(),
    }


def tell_what_is_in_clear(keys: Sequence[str], file: Path) -> None:
    """Say which values, maybe secrets, are written into a file."""
    if keys:
        logging.getLogger(__name__).warning(IN_CLEAR, ", ".join(keys), file)


def digests(study: Study) -> dict[str, str]:
    """Digests of the user's modules, and of the files that components read (`source_files`), by name."""
    contents: dict[str, list[bytes]] = {}
    for component in vars(study).values():
        for file in map(Path, getattr(component, "source_files", ())):
            contents.setdefault("/".join(file.parts[-2:]), []).append(file.read_bytes())
    files = {name: short_digest(b"".join(each)) for name, each in contents.items()}
    return {**study.composition.code, **files}


def model_digest(study: Study) -> str:
    """Digest of the nominal model's class, values and files, whichever of the values are uncertain.

    A task may hold values of the model, as its `robot`.
    """
    fields, task = study.composition.identity_fields["nominal"].items(), study.config["task"]
    values = {key: value for key, value in fields if key not in ("file", "uncertainty", "sampled")}
    values |= {"robot": task["robot"]} if "robot" in task else {}
    files = [Path(file).read_bytes() for file in getattr(study.nominal, "source_files", ())]
    return short_digest(b"".join([json.dumps(values, sort_keys=True).encode(), *files]))


def changed_code(before: Mapping[str, Any], study: Study) -> str:
    """Modules of the user's, and files, that changed since a study was described; "" if none did."""
    then, now = before.get("code", {}), digests(study)
    return ", ".join(sorted(name for name in {*then, *now} if then.get(name) != now.get(name)))


def provenance() -> dict[str, Any]:
    """User, commit and versions, as far as they are known."""
    user: dict[str, str] = {}
    with suppress(OSError, KeyError):  # a user without a name, as in some containers
        user = {"user": getpass.getuser()}
    return {**user, **_commit(), "versions": _versions()}


@cache
def _commit() -> dict[str, Any]:
    """Commit of the checkout that the package runs from, and whether it was changed; nothing without one."""
    if not (PACKAGE.parent / ".git").exists():
        return {}
    try:
        return {
            "commit": _git("rev-parse", "--verify", "HEAD"),
            "changed": bool(_git("status", "--porcelain", "--untracked-files=no")),
        }
    except (OSError, subprocess.SubprocessError):
        return {}


def _git(*arguments: str) -> str:
    """Answer of git about the checkout."""
    command = ["git", "-C", str(PACKAGE.parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()


@cache
def _versions() -> dict[str, str]:
    """Versions of Python, simbias, what it requires, and of the extras that are installed."""
    versions = {"python": platform.python_version()}
    with suppress(PackageNotFoundError):  # it runs from a checkout, and nothing is known
        for line in ["simbias", *(requires("simbias") or [])]:
            package = re.split(r"[^\w\-.]", line)[0]
            if not TOOLS.search(line):
                with suppress(PackageNotFoundError):  # an extra's
                    versions[package] = version(package)
    return versions
