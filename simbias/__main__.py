"""The command line: `python -m simbias [command] [override ...]`."""

from __future__ import annotations

import argparse
import gc
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from simbias import __version__, load_trial
from simbias.config import ConfigError, Variations
from simbias.core.commands import BAD_INPUT, FAILED, INTERRUPTED, SUCCEEDED, python
from simbias.core.interruption import Interruption
from simbias.core.messages import words
from simbias.terminal.arguments import RUN, parse
from simbias.terminal.study_warnings import warnings_in_one_line

if TYPE_CHECKING:
    from simbias.mlflow.tracking import Mlflow
    from simbias.terminal.identify import Request

GARBAGE = 100_000  # new objects between garbage collections; Python's 700 costs a fifth of the start-up


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for; return the exit status."""
    gc.set_threshold(GARBAGE)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the parent process, as for a daemon
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    try:
        parsed = parse(arguments, __version__)
        with Interruption(), warnings_in_one_line():
            status = (_show_config if parsed.cfg else COMMANDS[parsed.command])(parsed)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader of our output, such as `head`, has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except ConfigError as error:
        print(f"simbias: {error}{_trace_of_own_code(error.__cause__)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("simbias: interrupted", file=sys.stderr)
        return INTERRUPTED
    except OSError as error:
        said = ConfigError(str(error.filename or ""), error.strerror or words(error))
        print(f"simbias: {said}{_trace_of_own_code(error)}", file=sys.stderr)
        return BAD_INPUT


def _trace_of_own_code(error: BaseException | None) -> str:
    """Where the traceback is, for an error that passed through the user's own code."""
    from simbias.core.error_origin import has_own_code
    from simbias.terminal.lines import place_of_trace

    return "" if error is None or not has_own_code(error) else place_of_trace(error)


def _check(parsed: argparse.Namespace) -> int:
    """Run the conformance suite on components."""
    from simbias.terminal.check import check

    return SUCCEEDED if check(parsed.overrides, parsed.config_dir, parsed.allow) else FAILED


def _preview(parsed: argparse.Namespace) -> int:
    """Show the prediction of the first experiment."""
    from simbias.terminal.preview import preview

    preview(parsed.overrides, parsed.config_dir, parsed.allow)
    return SUCCEEDED


def _pictures(parsed: argparse.Namespace) -> int:
    """Draw all pictures of a trial."""
    from simbias.pictures.trial.gallery import save_all

    trial = load_trial(parsed.trial, uri=parsed.uri, config_dir=parsed.config_dir, allow=parsed.allow)
    files = save_all(trial.study, trial.iterations, Path(parsed.folder), trial.withdrawn)
    print(f"{parsed.folder}: {', '.join(files)} of {trial.study.title}, seed {trial.study.seed}")
    return SUCCEEDED


def _controller(parsed: argparse.Namespace) -> int:
    """Write a controller that runs a trial's last policy."""
    from simbias.lab.requests.folder import write_controller

    trial = load_trial(parsed.trial, uri=parsed.uri, config_dir=parsed.config_dir, allow=parsed.allow)
    policy = f"the last policy of {trial.study.title}, seed {trial.study.seed}: {trial.outcome}"
    if trial.changed_code:
        policy += f", but its code or files have changed since ({trial.changed_code})"
    files = write_controller(trial.next_experiment, Path(parsed.folder), policy)
    print(f"{parsed.folder}: {', '.join(files)} of {policy}")
    return SUCCEEDED


def _report(parsed: argparse.Namespace) -> int:
    """Write the HTML report of a trial or a sweep."""
    from simbias.report.pages import write_report

    for file in write_report(parsed.folder, parsed.config_dir, parsed.allow):
        print(f"Look at it:  {file}")
    return SUCCEEDED


def _identify(parsed: argparse.Namespace) -> int:
    """Identify a model from recordings; on request, start a trial with it."""
    from simbias.terminal.excite import recovery
    from simbias.terminal.identify import identify

    request = _of_recordings(parsed)
    if parsed.recover:
        return SUCCEEDED if recovery(request) else FAILED
    usable = identify(request, parsed.attach)
    if not parsed.attach or not usable:
        return SUCCEEDED if usable else FAILED
    parsed.overrides, parsed.config_dir = request.again, str(request.configs)
    return _run(parsed)


def _excite(parsed: argparse.Namespace) -> int:
    """Write excitation inputs whose recordings are most informative."""
    from simbias.terminal.excite import excite

    excite(_of_recordings(parsed), parsed.seconds, Path(parsed.into))
    return SUCCEEDED


def _of_recordings(parsed: argparse.Namespace) -> Request:
    """Recordings, overrides and folders, as the command line names them."""
    from simbias.recordings.reading import columns
    from simbias.terminal.identify import Request

    places, held_out = _places(parsed.words), _places(parsed.held_out)
    overrides = [word for word in (*parsed.words, *parsed.held_out) if word not in (*places, *held_out)]
    named = columns(parsed.columns) if parsed.columns else None
    folder = Path(parsed.into)
    return Request(places, held_out, overrides, named, folder, parsed.config_dir, parsed.allow)


def _places(words: Sequence[str]) -> list[str]:
    """The words that name files or folders, and are no overrides."""
    return [word for word in words if os.path.exists(word) or not re.match(r"~[^/]|.*=", word)]


def _withdraw(parsed: argparse.Namespace) -> int:
    """Withdraw an experiment from a trial."""
    from simbias.core.messages import counted
    from simbias.trial.folder import withdraw

    withdrawal = withdraw(parsed.file, parsed.reason)
    steps = len(withdrawal.superseded)
    counts = f"{counted(steps, 'later step')} no longer count{'s' if steps == 1 else ''}"
    print(f"{withdrawal}; {counts}. The trial's own command resumes the trial.")
    return SUCCEEDED


def _new(parsed: argparse.Namespace) -> int:
    """Lay out a folder for the user's own robot."""
    from simbias.terminal.new import new

    new(parsed.name)
    return SUCCEEDED


def _run(parsed: argparse.Namespace) -> int:
    """Run a trial or a sweep."""
    variations = Variations(parsed.overrides, parsed.config_dir, parsed.allow)
    composition = variations.composition({})
    if "sweep" in composition.config:
        from simbias.terminal import sweep

        if parsed.earlier:
            raise ConfigError("--continue", "a sweep continues no trial")
        return sweep.run(variations, composition, _command(parsed))
    from simbias.terminal import trial

    return trial.run(composition, _command(parsed), parsed.earlier, parsed.config_dir, parsed.allow)


def _show_config(parsed: argparse.Namespace) -> int:
    """Print the config composed from a command's overrides."""
    from omegaconf import OmegaConf

    if "overrides" not in parsed or "hash" in parsed:
        problem = f"{parsed.command} has no config to show; run, check, preview and export have one"
        raise ConfigError("--cfg", problem)
    composition = Variations(parsed.overrides, parsed.config_dir, parsed.allow).composition({})
    print(OmegaConf.to_yaml(OmegaConf.create(dict(composition.config))), end="")
    return SUCCEEDED


def _export(parsed: argparse.Namespace) -> int:
    """Export folders of trials and sweeps to MLflow, by default the store's; unreadable ones are reported."""
    folders = _places(parsed.overrides)
    parsed.overrides = [word for word in parsed.overrides if word not in folders]
    store = _mlflow(parsed)
    for folder in map(Path, folders) if folders else [None]:
        for line in store.export(folder):
            print(line)
    return FAILED if store.unshown else SUCCEEDED


def _ui(parsed: argparse.Namespace) -> int:
    """Open MLflow in a browser."""
    if "=" in (parsed.hash or ""):
        parsed.overrides, parsed.hash = [parsed.hash, *parsed.overrides], None
    with suppress(KeyboardInterrupt):
        _mlflow(parsed).show(parsed.hash, parsed.port)
    return SUCCEEDED


def _mlflow(parsed: argparse.Namespace) -> Mlflow:
    """The MLflow store that the overrides name."""
    from simbias.config.build import service
    from simbias.mlflow.tracking import Mlflow
    from simbias.sweep.tracking import Tracking

    composition = Variations(parsed.overrides, parsed.config_dir, parsed.allow).composition({})
    store: Tracking = service(composition, "tracking", Tracking)
    if not isinstance(store, Mlflow):
        raise ConfigError("tracking", "has no store to export to; tracking=mlflow has")
    return store


def _command(parsed: argparse.Namespace) -> str:
    """The command line as text, for repeating the command."""
    config_dir = ["--config-dir", parsed.config_dir] if parsed.config_dir else []
    allow = [word for module in parsed.allow for word in ("--allow", module)]
    earlier = ["--continue", str(parsed.earlier)] if parsed.earlier else []
    return f"{python()} {shlex.join(['-m', 'simbias', *config_dir, *allow, *parsed.overrides, *earlier])}"


COMMANDS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    RUN: _run,
    "check": _check,
    "preview": _preview,
    "export": _export,
    "ui": _ui,
    "identify": _identify,
    "excite": _excite,
    "pictures": _pictures,
    "controller": _controller,
    "report": _report,
    "withdraw": _withdraw,
    "new": _new,
}


if __name__ == "__main__":
    sys.exit(main())
