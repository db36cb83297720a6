"""`python -m simbias check`: run the conformance suite on components."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape

from simbias.config import compose
from simbias.config.build import build
from simbias.config.hydra_config import overridden
from simbias.core.messages import counted
from simbias.terminal.lines import place_of_trace, say, standard_output
from simbias.testing.conformance import CHECKS, ConformanceError, verdicts


def check(overrides: Sequence[str], config_dir: str | None, allow: Sequence[str] = ()) -> bool:
    """Check the groups named by the overrides, or all except the hardware; print each result.

    Checks of other groups run no experiments on the hardware. Errors as for `simbias.load`.
    """
    console = standard_output()
    study = build(compose(overrides, config_dir, allow))
    covered = {each.group for each in CHECKS}
    groups = covered & set(overridden(overrides)) or covered - {"hardware"}
    problems = 0
    for verdict in verdicts(study, groups):
        problems += bool(verdict.problem)
        mark = "[red]fails[/red]" if verdict.problem else "[green]holds[/green]"
        say(console, f"{mark}  {escape(str(verdict.check))}", markup=True)
        if verdict.problem:
            error = verdict.error
            trace = "" if error is None or isinstance(error, ConformanceError) else place_of_trace(error)
            say(console, f"       {verdict.problem}{trace}")
    chosen = ", ".join(f"{group} {study.choices[group]}" for group in sorted(groups))
    end = f"{counted(problems, 'check')} failed" if problems else "all checks hold"
    say(console, f"{chosen}: {end}.")
    if "hardware" not in groups:
        named = f"hardware={study.choices['hardware']}"
        say(console, f"The hardware was not checked: it may move. {named} checks it in short experiments.")
    return not problems
