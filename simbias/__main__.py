"""The command line: `python -m simbias [command] [override ...]`."""

from __future__ import annotations

import argparse
import gc
import os
import shlex
import sys
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simbias import __version__, load_trial
from simbias.config import Composition, ConfigError, Variations, options, sweeps
from simbias.core.commands import BAD_INPUT, FAILED, INTERRUPTED, SUCCEEDED, python
from simbias.core.interruption import Interruption

if TYPE_CHECKING:
    from simbias.mlflow.tracking import Mlflow
    from simbias.terminal.identify import Request

PROGRAM = "python -m simbias"
GARBAGE = 100_000  # new objects between two garbage collections; Python's 700 cost a fifth of a start
RUN = "run"  # the command that is meant where none is named

EXAMPLES = """\
values that people change most (--cfg job shows all):
  seed=3                               another trial
  preset=cartpole                      another robot; 'preset=[cartpole,robust]': and another method
  method.max_iterations=10             N_out; method.experiments=2 in each
  optimizer.max_evaluations=1000       N_in, simulated rollouts of one policy search
  task.horizon=5000                    T, frames of task.time_step in s
  experiment_timeout=60                s of wall time, after which a hardware experiment is stopped
  hardware.confirm=true                show what is predicted, and ask, before the first experiment
  hardware.safety.states={angle: 0.5}  abort beyond; also inputs, input_rates (per s), criteria=true
  tracking.uri=sqlite:///mlflow.db     any MLflow tracking URI
of the default robot:
  hardware.noise.torque_variance=0.1   (N m)^2; also angle_variance (rad^2), velocity_variance ((rad/s)^2)
  hardware.inertia_error=0.2           the hardware's masses and inertias are 20% larger
  hardware.feet=separate               two feet that can tip

examples:
  python -m simbias
  python -m simbias bias=none hardware.noise.torque_variance=0.1 optimizer=nlopt_crs seed=3
  python -m simbias --config-dir my_conf nominal=my_robot
  python -m simbias +sweep=table2 sweep.trials=2 bias=none engine.n_jobs=2
  python -m simbias +sweep=table2 sweep.dry_run=true   # what would run, and how long
  python -m simbias check --config-dir my_conf nominal=my_robot   # does it keep its contract?
  python -m simbias new my_robot       # lay out a folder for a robot of your own, which runs as it is
  python -m simbias export tracking.uri=sqlite:///other.db   # show the trials of ./trials in MLflow
  python -m simbias ui                 # open MLflow; `ui HASH` at a trial or a sweep
  python -m simbias pictures trials/7a29f4c5425f my_pictures   # PNG, SVG and GIF
  python -m simbias identify RECORDINGS preset=double_pendulum   # a model from CSV files
  python -m simbias withdraw trials/7a29f4c5425f/0004_experiment.npz --reason "a loose cable"
  python -m simbias preview            # what the first experiment is predicted to do; none is made

exit status: 0 the policy succeeded on hardware, 1 it did not, 2 bad input, 3 a hardware experiment is awaited
             (the same command resumes), 130 interrupted (likewise)
of a sweep:  0 all trials ran, whether they succeeded or not, 1 one raised an error, 2, 3 and 130 as above
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for; return the exit status."""
    gc.set_threshold(GARBAGE)
    parsed = _parsed(arguments)
    try:
        with Interruption():
            status: int = parsed.command(parsed)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # who reads our output, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except ConfigError as error:
        print(f"simbias: {error}{_trace_of_own_code(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("simbias: interrupted", file=sys.stderr)
        return INTERRUPTED


def _trace_of_own_code(error: ConfigError) -> str:
    """The place of the traceback of an error from the user's own code."""
    from simbias.core.error_origin import has_own_code
    from simbias.core.messages import with_trace
    from simbias.terminal.lines import temporary_traceback

    if error.__cause__ is None or not has_own_code(error.__cause__):
        return ""
    file = temporary_traceback(with_trace(error.__cause__))
    return f" (traceback in {file})" if file else ""


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The arguments, and the `command` that is to be called with them; options may stand anywhere."""
    own = argparse.ArgumentParser(prog=PROGRAM, add_help=False, allow_abbrev=False)
    own.add_argument("--config-dir", metavar="DIR", help="a folder with groups, options, sweeps/ of your own")
    allowed = "also let configs name classes of this module, as of those next to DIR; may be repeated"
    own.add_argument("--allow", metavar="MODULE", action="append", default=[], help=allowed)
    own.add_argument("--cfg", choices=["job"], help="print the composed config and exit")
    own.add_argument("--version", action="version", version=f"simbias {__version__}")
    known, rest = own.parse_known_args(arguments)
    parser, commands = _parser(own, known.config_dir)
    if not rest or rest[0] not in (*commands, "-h", "--help"):
        rest = [RUN, *rest]
    return argparse.Namespace(**{**vars(parser.parse_args(rest)), **vars(known)})


def _parser(
    own: argparse.ArgumentParser, config_dir: str | None
) -> tuple[argparse.ArgumentParser, Collection[str]]:
    """The command line's grammar and its commands; help tells of the options in a folder of configs too."""
    text: dict[str, Any] = {
        "parents": [own],
        "epilog": _groups(config_dir) + EXAMPLES,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }
    about = "Learn a simulation's bias and optimise a policy with few hardware experiments."
    usage = "%(prog)s [command] [override ...] [--config-dir DIR] [--allow MODULE] [--cfg job]"
    parser = argparse.ArgumentParser(prog=PROGRAM, usage=usage, description=about, **text)
    commands = parser.add_subparsers(metavar="command", title="commands")
    run = commands.add_parser(RUN, help="run a trial or a sweep, or resume it: the default", **text)
    check = commands.add_parser("check", help="put components through the conformance suite", parents=[own])
    preview = commands.add_parser(
        "preview", help="show what the first experiment is predicted to do", parents=[own]
    )
    export = commands.add_parser("export", help="show trials of a folder in an MLflow store", parents=[own])
    ui = commands.add_parser("ui", help="open MLflow at a trial or a sweep", parents=[own])
    pictures = commands.add_parser("pictures", help="draw all pictures of a trial", parents=[own])
    identify = commands.add_parser(
        "identify", help="identify a model from recordings, and tell what of it to trust", parents=[own]
    )
    excite = commands.add_parser("excite", help="write inputs whose recordings tell most", parents=[own])
    report = commands.add_parser("report", help="write one HTML page of a trial or a sweep", parents=[own])
    withdraw = commands.add_parser("withdraw", help="take an experiment out of a trial; its file is kept")
    new = commands.add_parser("new", help="lay out a folder for a robot of your own", parents=[own])
    ui.add_argument("hash", nargs="?", help="of a trial or a sweep; without one, the list of all")
    ui.add_argument("--port", type=int, help="of MLflow's server (default: 5000, or one that is free)")
    takes_overrides = {run: _run_or_show, check: _check, preview: _preview, export: _export, ui: _ui}
    for each, command in takes_overrides.items():
        each.add_argument("overrides", nargs="*", metavar="override", help="group=option or group.key=value")
        each.set_defaults(command=command)
    pictures.add_argument("trial", help="its folder, or its run in MLflow")
    pictures.add_argument("folder", help="of the PNG, SVG and GIF files")
    pictures.add_argument("--uri", default="sqlite:///mlflow.db", help="of the run (default: %(default)s)")
    pictures.set_defaults(command=_pictures)
    report.add_argument("folder", type=Path, help="of a trial or a sweep, or that of all trials")
    report.set_defaults(command=_report)
    for each, into, command in ((identify, "identified", _identify), (excite, "excitation.csv", _excite)):
        each.add_argument("words", nargs="*", metavar="recording|override", help="files, folders, overrides")
        each.add_argument("--columns", metavar="YAML", help="'{pos1: q1, vel1: dq1}', or a file of that")
        each.add_argument("--into", default=into, metavar="PATH", help=f"where results go: {into}")
        each.set_defaults(command=command, held_out=[])
    identify.add_argument(
        "--held-out", nargs="+", default=[], metavar="FILE", help="predicted, never fitted to"
    )
    identify.add_argument("--attach", action="store_true", help="start a trial with what was identified")
    identify.add_argument(
        "--recover", action="store_true", help="simulate such recordings: which parameters would come back?"
    )
    excite.add_argument("--seconds", type=float, default=5.0, help="duration: 5")
    withdraw.add_argument(
        "file", type=Path, help="of the experiment, as trials/7a29f4c5425f/0004_experiment.npz"
    )
    withdraw.add_argument("--reason", default="", help="why, for who looks at the trial")
    withdraw.set_defaults(command=_withdraw)
    new.add_argument("name", help="of a Python module, as my_robot")
    new.set_defaults(command=_new)
    return parser, commands.choices


def _groups(config_dir: str | None) -> str:
    """The groups with their options, and the sweeps, as help shows them."""
    groups = "\n".join(f"  {group:<14} {' | '.join(names)}" for group, names in options(config_dir).items())
    return (
        f"groups and their options, the default first (group=option):\n{groups}\n\n"
        f"sweeps, many trials in a grid (+sweep=name):\n  {' | '.join(sweeps(config_dir))}\n\n"
    )


def _check(parsed: argparse.Namespace) -> int:
    """Put components through the conformance suite."""
    from simbias.terminal.check import check

    return SUCCEEDED if check(parsed.overrides, parsed.config_dir, parsed.allow) else FAILED


def _preview(parsed: argparse.Namespace) -> int:
    """Show what the first experiment is predicted to do."""
    from simbias.terminal.preview import preview

    preview(parsed.overrides, parsed.config_dir, parsed.allow)
    return SUCCEEDED


def _pictures(parsed: argparse.Namespace) -> int:
    """Draw all pictures of a trial."""
    from simbias.pictures.trial.gallery import save_all

    trial = load_trial(parsed.trial, parsed.uri, parsed.config_dir, parsed.allow)
    files = save_all(trial.study, trial.iterations, Path(parsed.folder), trial.withdrawn)
    print(f"{parsed.folder}: {', '.join(files)} of {trial.study.title}, seed {trial.study.seed}")
    return SUCCEEDED


def _report(parsed: argparse.Namespace) -> int:
    """Write the page of a trial or a sweep."""
    from simbias.report.folder import write_report

    for file in write_report(parsed.folder, parsed.config_dir, parsed.allow):
        print(f"Look at it:  {file}")
    return SUCCEEDED


def _identify(parsed: argparse.Namespace) -> int:
    """Identify a model from recordings, and start a trial with it if that is asked for."""
    from simbias.terminal.excite import recovery
    from simbias.terminal.identify import identify

    request = _of_recordings(parsed)
    if parsed.recover:
        return SUCCEEDED if recovery(request) else FAILED
    better = identify(request)
    if not parsed.attach or not better:
        return SUCCEEDED if better else FAILED
    parsed.overrides, parsed.config_dir = request.again, str(request.configs)
    return _run_or_show(parsed)


def _excite(parsed: argparse.Namespace) -> int:
    """Write inputs whose recordings tell most."""
    from simbias.terminal.excite import excite

    excite(_of_recordings(parsed), parsed.seconds, Path(parsed.into))
    return SUCCEEDED


def _of_recordings(parsed: argparse.Namespace) -> Request:
    """Recordings, overrides and folders, as the command line names them."""
    from simbias.recordings.reading import columns
    from simbias.terminal.identify import Request

    places = [word for word in parsed.words if "=" not in word or os.path.exists(word)]
    overrides = [word for word in parsed.words if word not in places]
    named = columns(parsed.columns) if parsed.columns else None
    folder = Path(parsed.into)
    return Request(places, parsed.held_out, overrides, named, folder, parsed.config_dir, parsed.allow)


def _withdraw(parsed: argparse.Namespace) -> int:
    """Take an experiment out of a trial."""
    from simbias.core.messages import counted
    from simbias.trial.folder import withdraw

    withdrawal = withdraw(parsed.file, parsed.reason)
    steps = counted(len(withdrawal.superseded), "step")
    print(f"{withdrawal}; {steps} after it count no longer. The trial's own command resumes it.")
    return SUCCEEDED


def _new(parsed: argparse.Namespace) -> int:
    """Lay out a folder for a robot of the user's own."""
    from simbias.terminal.new import new

    new(parsed.name)
    return SUCCEEDED


def _run_or_show(parsed: argparse.Namespace) -> int:
    """Run a trial or a sweep, or print its config."""
    variations = Variations(parsed.overrides, parsed.config_dir, parsed.allow)
    composition = variations.composition({})
    if parsed.cfg:
        print(_as_yaml(composition), end="")
        return SUCCEEDED
    if "sweep" in composition.config:
        from simbias.terminal import run_sweep

        return run_sweep.run(variations, composition, _command(parsed))
    from simbias.terminal import run

    return run.run(composition, _command(parsed))


def _as_yaml(composition: Composition) -> str:
    """The composed config."""
    from omegaconf import OmegaConf

    return OmegaConf.to_yaml(OmegaConf.create(dict(composition.config)))


def _export(parsed: argparse.Namespace) -> int:
    """Show the trials and sweeps of a folder in MLflow."""
    for line in _mlflow(parsed).export_all():
        print(line)
    return SUCCEEDED


def _ui(parsed: argparse.Namespace) -> int:
    """Open MLflow in a browser."""
    if "=" in (parsed.hash or ""):
        parsed.overrides, parsed.hash = [parsed.hash, *parsed.overrides], None
    with suppress(KeyboardInterrupt):
        _mlflow(parsed).show(parsed.hash, parsed.port)
    return SUCCEEDED


def _mlflow(parsed: argparse.Namespace) -> Mlflow:
    """The store that the overrides name."""
    from simbias.config.build import service
    from simbias.mlflow.tracking import Mlflow
    from simbias.sweep.tracking import Tracking

    composition = Variations(parsed.overrides, parsed.config_dir, parsed.allow).composition({})
    store: Tracking = service(composition, "tracking", Tracking)
    if not isinstance(store, Mlflow):
        raise ConfigError("tracking", "exports to no store; tracking=mlflow does")
    return store


def _command(parsed: argparse.Namespace) -> str:
    """The command line, to be typed again."""
    config_dir = ["--config-dir", parsed.config_dir] if parsed.config_dir else []
    allow = [word for module in parsed.allow for word in ("--allow", module)]
    return f"{python()} {shlex.join(['-m', 'simbias', *config_dir, *allow, *parsed.overrides])}"


if __name__ == "__main__":
    sys.exit(main())
