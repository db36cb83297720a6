"""Pictures from the command line: of a stored trial, or of one that runs for it.

`python -m simbias.pictures RUN_ID FOLDER` and `python -m simbias.pictures OUT.png [override ...]`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from simbias import load, load_trial
from simbias.core import HardwareError, Waiting
from simbias.core.commands import add_own_components
from simbias.core.errors import ConfigError
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.style import save
from simbias.pictures.trial.gallery import save_all
from simbias.pictures.trial.overview import overview

DONE, FAILED, BAD_INPUT = 0, 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Save what the arguments ask for; return the exit status."""
    parser = _parser()
    parsed = parser.parse_args(arguments)
    try:
        if parsed.what.endswith(".png"):
            return _run(parser, Path(parsed.what), parsed)
        if len(parsed.more) != 1:
            parser.error(f"{parsed.what}: neither OUT.png nor a RUN_ID that one FOLDER follows")
        return _read(Path(parsed.more[0]), parsed)
    except ConfigError as error:
        print(f"simbias: {error}", file=sys.stderr)
        return BAD_INPUT
    except (HardwareError, Waiting) as error:
        print(f"simbias: hardware: {error}", file=sys.stderr)
        return FAILED
    except NoPictureError as error:
        print(f"simbias: no picture: {error}", file=sys.stderr)
        return FAILED


def _parser() -> argparse.ArgumentParser:
    """The command line's grammar."""
    parser = argparse.ArgumentParser(
        prog="python -m simbias.pictures",
        usage="%(prog)s (RUN_ID FOLDER [--uri URI] | OUT.png [override ...]) "
        "[--config-dir DIR] [--allow MODULE]",
        description="Save all pictures of a trial in a store, as PNG, SVG and GIF; "
        "or run a trial that no store keeps, and save its overview.",
    )
    parser.add_argument(
        "what", metavar="RUN_ID | OUT.png", help="a trial's run in MLflow, or the file to write"
    )
    parser.add_argument(
        "more", nargs="*", metavar="FOLDER | override", help="overrides as of python -m simbias"
    )
    parser.add_argument("--uri", default="sqlite:///mlflow.db", help="the run's store (default: %(default)s)")
    add_own_components(parser)
    return parser


def _read(folder: Path, parsed: argparse.Namespace) -> int:
    """Save all pictures of a stored trial."""
    trial = load_trial(parsed.what, parsed.uri, parsed.config_dir, parsed.allow)
    if not trial.iterations:
        raise ConfigError(parsed.what, "no iteration has ended, so there is nothing to draw")
    files = save_all(trial.study, trial.iterations, folder)
    print(f"{folder}: {', '.join(files)} of {trial.study.title}, seed {trial.study.seed}")
    return DONE


def _run(parser: argparse.ArgumentParser, out: Path, parsed: argparse.Namespace) -> int:
    """Run a trial that no store keeps, and save its overview."""
    if not out.parent.is_dir():
        parser.error(f"{out}: OUT.png has to be in a folder that exists")
    study = load(parsed.more, parsed.config_dir, parsed.allow)
    iterations = list(study.run())
    save(overview(study, iterations), out)
    print(f"{out}: {study.title}, seed {study.seed}")
    return DONE


if __name__ == "__main__":
    sys.exit(main())
