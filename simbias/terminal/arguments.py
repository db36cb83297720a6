"""The grammar of the command line: commands, their arguments, and their help texts."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

from simbias.config import ConfigError, options, sweeps

PROGRAM = "python -m simbias"
HELP = {"-h", "--help"}
RUN = "run"  # the default command

EXAMPLES = """\
values that people change most (--cfg job shows all):
  seed=3                               another trial
  preset=cartpole                      another robot; 'preset=[cartpole,robust]': another method, too
  method.max_iterations=10             N_out; method.experiments=2 sets how many experiments each has
  optimizer.max_evaluations=1000       N_in, simulated rollouts of one policy search
  task.horizon=5000                    T, in frames of task.time_step (s)
  experiment_timeout=60                stop a hardware experiment after this wall time in s
  hardware.confirm=true                show the prediction and ask before the first experiment
  hardware.safety.states={angle: 0.5}  abort beyond limits; also inputs, input_rates (per s), criteria=true
  tracking.uri=sqlite:///mlflow.db     MLflow's store: a database, or the http:// address of a server
for the default robot:
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
  python -m simbias new my_robot       # create a folder for your own robot, which runs as it is
  python -m simbias export trials tracking.uri=sqlite:///other.db   # show all trials of a folder in MLflow
  python -m simbias ui                 # open MLflow; `ui HASH` at a trial or a sweep
  python -m simbias pictures trials/7a29f4c5425f my_pictures   # PNG, SVG, PDF and GIF
  python -m simbias identify RECORDINGS preset=double_pendulum   # a model from CSV files
  python -m simbias method.max_iterations=20 --continue trials/7a29f4c5425f   # keeps its experiments
  python -m simbias withdraw trials/7a29f4c5425f/0004_experiment.npz --reason "a loose cable"
  python -m simbias preview            # what the first experiment is predicted to do; none is run

exit status: 0 the policy succeeded on hardware, 1 it did not or an error stopped the trial, 2 bad input,
             3 a hardware experiment is awaited, 130 interrupted (after both, the same command resumes)
for a sweep: 0 all trials ran, whether they succeeded or not, 1 one raised an error, 2 and 130 as above,
             3 also if another process is running one of its trials
for export:  0 all trials are shown, 1 one could not be read
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
    own.add_argument("--config-dir", metavar="DIR", help="a folder with your own groups, options and sweeps/")
    allowed = "let configs use classes of this module (those beside DIR are allowed anyway); may be repeated"
    own.add_argument("--allow", metavar="MODULE", action="append", default=[], help=allowed)
    own.add_argument("--version", action="version", version=f"simbias {version}")
    shown = argparse.ArgumentParser(prog=PROGRAM, add_help=False, allow_abbrev=False, parents=[own])
    shown.add_argument("--cfg", choices=["job"], help="print the composed config and exit")
    known, rest = shown.parse_known_args(arguments)
    parser, commands = _parser(own, shown, known.config_dir)
    if not rest or rest[0] not in (*commands, "-h", "--help"):
        if rest and "=" not in rest[0] and rest[0][:1] not in ("-", "~"):
            known_names = ", ".join(get_close_matches(rest[0], commands, len(commands), 0.0))
            raise ConfigError("", f"no such command: {rest[0]}; available: {known_names}")
        if rest and "=" in rest[0] and not HELP & {*rest}:
            for before, word in pairwise(rest):
                if word in commands and not before.startswith("-"):
                    raise ConfigError("", f"write the command first: {PROGRAM} {word} {rest[0]} ...")
        rest = [RUN, *rest]
    parsed, behind = parser.parse_known_args(rest)
    words: Any = vars(parsed).get("words", vars(parsed).get("overrides"))
    if behind and (words is None or any(word.startswith("-") for word in behind)):
        several = "; a sweep runs many trials (+sweep=NAME)" if {"-m", "--multirun"} & {*behind} else ""
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
    of_run = (
        "It writes trials/<hash>, and for a sweep also trials/sweeps/<name>_<hash>, unless tracking=none."
    )
    run = _add(commands, RUN, "run or resume a trial or a sweep (the default)", of_run, **text)
    earlier = "begin with the steps of an ended trial, if only budget or method.max_iterations differ"
    run.add_argument("--continue", dest="earlier", metavar="TRIAL", type=Path, help=earlier)
    check = _add(commands, "check", "run the conformance suite on components", parents=[shown])
    about = "show what the first experiment is predicted to do"
    preview = _add(commands, "preview", about, "It writes preview.png.", parents=[shown])
    of_export = "Folders are of a trial, of a sweep or of all trials (default: tracking.trials)."
    about = "show trials of a folder in an MLflow store"
    export = _add(commands, "export", about, of_export, parents=[shown])
    ui = _add(commands, "ui", "open MLflow at a trial or a sweep", parents=[own])
    ui.add_argument("hash", nargs="?", help="hash of a trial or a sweep; without it, all are listed")
    ui.add_argument("--port", type=int, help="port of MLflow's server (default: 5000, or a free one)")
    for each in (run, check, preview, export, ui):
        word = "folder|override" if each is export else "override"
        each.add_argument("overrides", nargs="*", metavar=word, help="group=option or group.key=value")


def _add_of_recordings(commands: Any, own: argparse.ArgumentParser) -> None:
    """Add the commands that identify a model, or prepare for it."""
    about = "identify a model from recordings, and report which parameters to trust"
    of_identify = "It writes a page, tables, posterior draws and a config option for trials into a folder."
    identify = _add(commands, "identify", about, of_identify, parents=[own])
    of_excite = "It writes them into a CSV file, with the states that they are predicted to cause."
    about = "design inputs whose recordings are most informative"
    excite = _add(commands, "excite", about, of_excite, parents=[own])
    for each, into in ((identify, "identified"), (excite, "excitation.csv")):
        each.add_argument("words", nargs="*", metavar="recording|override", help="files, folders, overrides")
        each.add_argument("--columns", metavar="YAML", help="'{pos1: q1, vel1: dq1}', or a YAML file")
        each.add_argument("--into", default=into, metavar="PATH", help=f"for the results (default: {into})")
        each.set_defaults(held_out=[], earlier=None)
    held_out = "held-out recordings, which are predicted but never fitted"
    identify.add_argument("--held-out", nargs="+", default=[], metavar="FILE", help=held_out)
    attach = "then start a trial with the identified model"
    recover = "only simulate such recordings, write nothing, and report which parameters would be recovered"
    either = identify.add_mutually_exclusive_group()
    either.add_argument("--attach", action="store_true", help=attach)
    either.add_argument("--recover", action="store_true", help=recover)
    excite.add_argument("--seconds", type=float, default=5.0, help="duration (default: 5)")


def _add_of_folders(commands: Any, own: argparse.ArgumentParser) -> None:
    """Add the commands that read, change or make a folder."""
    pictures = _add(commands, "pictures", "draw all pictures of a trial", parents=[own])
    of_policy = "Unlike an experiment, the controller does not end at the task's horizon."
    controller = _add(
        commands, "controller", "write a trial's last policy in C and in Python", of_policy, parents=[own]
    )
    for each, of_folder in (
        (pictures, "folder for PNG, SVG, PDF and GIF files"),
        (controller, "folder for controller.h, controller.py and policy.json"),
    ):
        each.add_argument("trial", help="the trial's folder, or its run in MLflow")
        each.add_argument("folder", help=of_folder)
        each.add_argument(
            "--uri", default="sqlite:///mlflow.db", help="store of the run (default: %(default)s)"
        )
    about = "write one HTML page of a trial or a sweep"
    report = _add(commands, "report", about, "The page is report.html in that folder.", parents=[own])
    of_page = "folder of a trial, of a sweep, or of all trials (writes a page for each sweep)"
    report.add_argument("folder", type=Path, help=of_page)
    of_withdraw = "The trial's own command then resumes the trial and repeats the experiment."
    withdraw = _add(commands, "withdraw", "take an experiment out of a trial; its file is kept", of_withdraw)
    of_file = "file of the experiment, such as trials/7a29f4c5425f/0004_experiment.npz"
    withdraw.add_argument("file", type=Path, help=of_file)
    withdraw.add_argument("--reason", default="", help="why, for readers of the trial's pages (optional)")
    of_new = "The folder has a module, configs, a test and a README."
    new = _add(commands, "new", "create a folder for your own robot", of_new, parents=[own])
    new.add_argument("name", help="name of a Python module, such as my_robot")


def _groups(config_dir: str | None) -> str:
    """The groups with their options, and the sweeps, as shown in help."""
    groups = "\n".join(f"  {group:<14} {' | '.join(names)}" for group, names in options(config_dir).items())
    return (
        f"groups and their options, the default first (group=option):\n{groups}\n\n"
        f"sweeps, many trials in a grid (+sweep=name):\n  {' | '.join(sweeps(config_dir))}\n\n"
    )
