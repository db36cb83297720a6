"""Provenance of a trial: versions of packages, the checkout's commit, the user, the user's own code.

Editing a comment makes no other trial, so changes are reported, and the user judges whether results still
count.
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
from simbias.trial.folder import TrialFolder
from simbias.trial.study import Study

TOOLS = re.compile(r"extra == .(docs|test)\b")  # requirements that no trial needs
IN_CLEAR = "simbias: %s: taken from the environment, and written in plain text to %s, which MLflow shows too"


def description(study: Study) -> dict[str, Any]:
    """A study in JSON's types: identity, config except the store's, versions and code."""
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
    """Report which values, perhaps secrets, are written into a file in plain text."""
    if keys:
        logging.getLogger(__name__).warning(IN_CLEAR, ", ".join(keys), file)


def digests(study: Study) -> dict[str, str]:
    """Digests of the user's modules, and of the files that components read (`source_files`), by name.

    A file is named by its own name and its folder's, which are the same on a cluster's workers.
    """
    contents: dict[str, list[bytes]] = {}
    for component in vars(study).values():
        for file in map(Path, getattr(component, "source_files", ())):
            contents.setdefault("/".join(file.absolute().parts[-2:]), []).append(file.read_bytes())
    files = {name: short_digest(b"".join(each)) for name, each in contents.items()}
    return {**study.composition.code, **files}


def model_digest(study: Study) -> str:
    """Digest of the nominal model's class, values and files, regardless of which values are uncertain.

    A task may hold values of the model, such as its `robot`.
    """
    fields, task = study.composition.identity_fields["nominal"].items(), study.config["task"]
    values = {key: value for key, value in fields if key not in ("file", "uncertainty", "sampled")}
    values |= {"robot": task["robot"]} if "robot" in task else {}
    files = [Path(file).read_bytes() for file in getattr(study.nominal, "source_files", ())]
    return short_digest(b"".join([json.dumps(values, sort_keys=True).encode(), *files]))


def changed_code(folder: TrialFolder, study: Study) -> str:
    """The user's modules, and files, that changed since a trial began, even if restored; "" if none did."""
    first = folder.description().get("code", {})
    later = [digests(study), *(each["code"] for each in folder.attempts() if "code" in each)]
    return ", ".join(sorted({name for code in later for name in _changed(first, code)}))


def _changed(first: Mapping[str, str], later: Mapping[str, str]) -> set[str]:
    """The names whose digests differ; a file that only moved to a folder of another name is the same."""
    gone, new = (
        {name: (Path(name).name, code[name]) for name in code.keys() - other.keys()}
        for code, other in ((first, later), (later, first))
    )
    moved = {*gone.values()} & {*new.values()}
    changed = {name for name in first.keys() & later.keys() if first[name] != later[name]}
    return changed | {name for name, file in {**gone, **new}.items() if file not in moved}


def provenance() -> dict[str, Any]:
    """User, commit and versions, as far as known."""
    user: dict[str, str] = {}
    with suppress(OSError, KeyError):  # the user may have no name, as in some containers
        user = {"user": getpass.getuser()}
    return {**user, **_commit(), "versions": _versions()}


@cache
def _commit() -> dict[str, Any]:
    """Commit of the checkout that the package runs from, and whether it was modified; or empty."""
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
    """Output of a git command on the checkout."""
    command = ["git", "-C", str(PACKAGE.parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()


@cache
def _versions() -> dict[str, str]:
    """Versions of Python, simbias, its requirements and the installed extras."""
    versions = {"python": platform.python_version()}
    with suppress(PackageNotFoundError):  # it runs from a checkout without metadata
        for line in ["simbias", *(requires("simbias") or [])]:
            package = re.split(r"[^\w\-.]", line)[0]
            if not TOOLS.search(line):
                with suppress(PackageNotFoundError):  # not every extra is installed
                    versions[package] = version(package)
    return versions
