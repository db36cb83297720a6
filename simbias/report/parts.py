"""Parts that pages of trials and of sweeps share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import yaml

from simbias.core.messages import printable
from simbias.pictures.elements.html import heading, items, preformatted

TOLD = ("user", "commit", "changed", "command")  # of a description, in words


def made_with(description: Mapping[str, Any]) -> Iterator[str]:
    """Config, versions and code."""
    yield heading("How it was made")
    lines = [f"{name}: {description[name]}" for name in ("hash", *TOLD) if description.get(name)]
    lines += [f"{name} {version}" for name, version in description.get("versions", {}).items()]
    lines += [f"{name}: own code or file, {digest}" for name, digest in description.get("code", {}).items()]
    yield items(printable(line) for line in lines)
    yield heading("Config")
    yield preformatted(yaml.safe_dump(description.get("config", {}), sort_keys=False, allow_unicode=True))
