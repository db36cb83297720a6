"""`python -m simbias new my_robot`: a folder for a custom robot, which runs unchanged."""

from __future__ import annotations

import keyword
from importlib.util import find_spec
from pathlib import Path

from simbias.core.commands import python
from simbias.core.errors import ConfigError
from simbias.core.messages import quote

TEMPLATE = Path(__file__).resolve().parent.parent / "templates" / "robot"
NAME = "my_robot"  # of the template


def new(name: str) -> None:
    """Lay out the folder, and print how to use it; ConfigError if the name is invalid or taken."""
    if not name.isidentifier() or keyword.iskeyword(name) or not name.isascii():
        raise ConfigError("new", f"expected the name of a Python module, such as {NAME}, got {quote(name)}")
    folder = Path(name)
    if folder.exists():
        raise ConfigError(name, "already exists; choose another name")
    if find_spec(name) is not None:
        raise ConfigError("new", f"a module named {name} is already installed; choose another name")
    for source in sorted(TEMPLATE.rglob("*")):
        if source.is_file() and source.suffix in (".py", ".yaml", ".md"):
            target = folder / str(source.relative_to(TEMPLATE)).replace(NAME, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(source.read_text(encoding="utf-8").replace(NAME, name), encoding="utf-8")
    command = f"{python()} -m simbias"
    print(f"Created {name}/, which runs as it is. To make it your robot, edit {name}/{name}.py.\n")
    print(f"cd {name}")
    for verb in ("check ", "preview ", ""):
        print(f"{command} {verb}--config-dir conf preset={name}")
