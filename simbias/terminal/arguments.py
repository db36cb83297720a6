"""The grammar of the command line: commands, their arguments, and their help texts."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from simbias.config import ConfigError, options, sweeps

PROGRAM = "python -m simbias"
RUN = "run"  # the default command

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
  tracking.uri=sqlite:///mlflow.db     MLflow's store: a database, or the http:// address of a server
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

exit status: 0 the policy succeeded on hardware, 1 it did not or an error stopped the trial, 2 bad input,
             3 a hardware experiment is awaited (the same command resumes), 130 interrupted (likewise)
of a sweep:  0 all trials ran, whether they succeeded or not, 1 one raised an error, 2 and 130 as above,
             3 also if another process runs one of its trials
of export:   0 all trials are shown, 1 one could not be read
"""


def parse(arguments: Sequence[str] | None, version: str) -> argparse.Namespace:
    """The requested `command` and its arguments; options may stand anywhere.

    Raises
    ------
    ConfigError
        If the first argument is neither a command nor an override.
    SystemExit
        With status 2 if they cannot be parsed, or 0 after showing help or the version.
    """
    own = argparse.ArgumentParser(prog=PROGRAM, add_help=False, allow_abbrev=False)
    own.add_argument("--config-dir", metavar="DIR", help="a folder with groups, options, sweeps/ of your own")
    allowed = "allow configs to name classes from this module too, like modules beside DIR; may be repeated"
    own.add_argument("--allow", metavar="MODULE", action="append", default=[], help=allowed)
    own.add_argument("--version", action="version", version=f"simbias {version}")
    shown = argparse.ArgumentParser(prog=PROGRAM, add_help=False, allow_abbrev=False, parents=[own])
    shown.add_argument("--cfg", choices=["job"], help="print the composed config and exit")
    known, rest = shown.parse_known_args(arguments)
    parser, commands = _parser(own, shown, known.config_dir)
    if not rest or rest[0] not in (*commands, "-h", "--help"):
        if rest and "=" not in rest[0] and rest[0][:1] not in ("-", "~"):
            known_names = ", ".join(get_close_matches(rest[0], commands, len(commands), 0.0))
            raise ConfigError("", f"no such command: {rest[0]}; there are {known_names}")
        rest = [RUN, *rest]
    parsed, behind = parser.parse_known_args(rest)
    words: Any = vars(parsed).get("words", vars(parsed).get("overrides"))
    if behind and (words is None or any(word.startswith("-") for word in behind)):
        several = "; many trials are a sweep (+sweep=NAME)" if {"-m", "--multirun"} & {*behind} else ""
        parser.error(f"unrecognized arguments: {' '.join(behind)}{several}")
    elif behind:
        words += behind  # a command's own option after argparse stopped taking options
    return argparse.Namespace(**{**vars(parsed), **vars(known)})


def _parser(
    own: argparse.ArgumentParser, shown: argparse.ArgumentParser, config_dir: str | None
) -> tuple[argparse.ArgumentParser, Collection[str]]:
    """The grammar and its commands; help also lists the options in a folder of configs."""
    text: dict[str, Any] = {
        "parents": [shown],
        "epilog": _groups(config_dir) + EXAMPLES,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }
    about = "Learn a simulation's bias and optimise a policy with few hardware experiments."
    usage = "%(prog)s [command] [override ...] [--config-dir DIR] [--allow MODULE] [--cfg job]"
    parser = argparse.ArgumentParser(prog=PROGRAM, usage=usage, description=about, **text)
    commands = parser.add_subparsers(dest="command", metavar="command", title="commands", prog=PROGRAM)
    _add_composed(commands, own, shown, text)
    _add_of_recordings(commands, own)
    _add_of_folders(commands, own)
    return parser, commands.choices


def _add(commands: Any, name: str, about: str, more: str = "", **text: Any) -> argparse.ArgumentParser:
    """Add a command; its own help also has details that do not fit the list of commands."""
    description = f"{about[0].upper()}{about[1:]}. {more}".rstrip()
    added: argparse.ArgumentParser = commands.add_parser(name, help=about, description=description, **text)
    return added


def _add_composed(
    commands: Any, own: argparse.ArgumentParser, shown: argparse.ArgumentParser, text: Mapping[str, Any]
) -> None:
    """Add the commands that take overrides."""
    of_run = "It writes trials/<hash>, of a sweep also trials/sweeps/<name>_<hash>, unless tracking=none."
    run = _add(commands, RUN, "run a trial or a sweep, or resume it: the default", of_run, **text)
    check = _add(commands, "check", "put components through the conformance suite", parents=[shown])
    about = "show what the first experiment is predicted to do"
    preview = _add(commands, "preview", about, "It writes preview.png.", parents=[shown])
    export = _add(commands, "export", "show trials of a folder in an MLflow store", parents=[shown])
    ui = _add(commands, "ui", "open MLflow at a trial or a sweep", parents=[own])
    ui.add_argument("hash", nargs="?", help="of a trial or a sweep; without one, the list of all")
    ui.add_argument("--port", type=int, help="of MLflow's server (default: 5000, or one that is free)")
    for each in (run, check, preview, export, ui):
        each.add_argument("overrides", nargs="*", metavar="override", help="group=option or group.key=value")


def _add_of_recordings(commands: Any, own: argparse.ArgumentParser) -> None:
    """Add the commands that identify a model, or prepare for it."""
    about = "identify a model from recordings, and tell what of it to trust"
    of_identify = "It writes a page, tables, draws and an option for trials into a folder."
    identify = _add(commands, "identify", about, of_identify, parents=[own])
    of_excite = "It writes a CSV file, which also has the states that they should lead to."
    excite = _add(commands, "excite", "write inputs whose recordings tell most", of_excite, parents=[own])
    for each, into in ((identify, "identified"), (excite, "excitation.csv")):
        each.add_argument("words", nargs="*", metavar="recording|override", help="files, folders, overrides")
        each.add_argument("--columns", metavar="YAML", help="'{pos1: q1, vel1: dq1}', or a file of that")
        each.add_argument("--into", default=into, metavar="PATH", help=f"where results go: {into}")
        each.set_defaults(held_out=[])
    held_out = "predicted, never fitted to"
    identify.add_argument("--held-out", nargs="+", default=[], metavar="FILE", help=held_out)
    identify.add_argument("--attach", action="store_true", help="start a trial with what was identified")
    recover = "simulate such recordings: which parameters would come back?"
    identify.add_argument("--recover", action="store_true", help=recover)
    excite.add_argument("--seconds", type=float, default=5.0, help="duration: 5")


def _add_of_folders(commands: Any, own: argparse.ArgumentParser) -> None:
    """Add the commands that read, change or make a folder."""
    pictures = _add(commands, "pictures", "draw all pictures of a trial", parents=[own])
    of_policy = "It does not stop at the task's horizon, where an experiment ends."
    controller = _add(
        commands, "controller", "write a trial's last policy in C and in Python", of_policy, parents=[own]
    )
    for each, of_folder in (
        (pictures, "where PNG, SVG and GIF files are written"),
        (controller, "where controller.h, controller.py and policy.json are written"),
    ):
        each.add_argument("trial", help="its folder, or its run in MLflow")
        each.add_argument("folder", help=of_folder)
        each.add_argument("--uri", default="sqlite:///mlflow.db", help="of the run (default: %(default)s)")
    about = "write one HTML page of a trial or a sweep"
    report = _add(commands, "report", about, "It is report.html, in the same folder.", parents=[own])
    of_page = "of a trial or a sweep, or that of all trials: a page of each sweep"
    report.add_argument("folder", type=Path, help=of_page)
    of_withdraw = "The trial's own command then resumes it, and makes the experiment again."
    withdraw = _add(commands, "withdraw", "take an experiment out of a trial; its file is kept", of_withdraw)
    of_file = "of the experiment, as trials/7a29f4c5425f/0004_experiment.npz"
    withdraw.add_argument("file", type=Path, help=of_file)
    withdraw.add_argument("--reason", default="", help="optional: why, for who looks at the trial")
    of_new = "It has a module, configs, a test and a README."
    new = _add(commands, "new", "lay out a folder for a robot of your own", of_new, parents=[own])
    new.add_argument("name", help="of a Python module, as my_robot")


def _groups(config_dir: str | None) -> str:
    """The groups with their options, and the sweeps, as shown in help."""
    groups = "\n".join(f"  {group:<14} {' | '.join(names)}" for group, names in options(config_dir).items())
    return (
        f"groups and their options, the default first (group=option):\n{groups}\n\n"
        f"sweeps, many trials in a grid (+sweep=name):\n  {' | '.join(sweeps(config_dir))}\n\n"
    )
