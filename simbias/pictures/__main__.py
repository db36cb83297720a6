"""Pictures from the command line: `python -m simbias.pictures (TRIAL FOLDER | OUT.png [override ...])`."""

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
from simbias.trial.run import TrialRecord

DONE, FAILED, BAD_INPUT = 0, 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw a trial of a store, or one that runs now and is not stored; return the exit status."""
    parser = _parser()
    parsed = parser.parse_args(arguments)
    try:
        if parsed.what.endswith(".png"):
            _draw_new(parsed.what, parsed)
        elif len(parsed.more) == 1:
            _draw_stored(parsed.what, Path(parsed.more[0]), parsed)
        else:
            parser.error(f"{parsed.what}: neither OUT.png nor a TRIAL that one FOLDER follows")
    except ConfigError as error:
        print(f"simbias: {error}", file=sys.stderr)
        return BAD_INPUT
    except (HardwareError, Waiting, NoPictureError) as error:
        kind = "no picture" if isinstance(error, NoPictureError) else "hardware"
        print(f"simbias: {kind}: {error}", file=sys.stderr)
        return FAILED
    return DONE


def _parser() -> argparse.ArgumentParser:
    """The command line's grammar."""
    parser = argparse.ArgumentParser(
        prog="python -m simbias.pictures",
        usage="%(prog)s (TRIAL FOLDER [--uri URI] | OUT.png [override ...]) "
        "[--config-dir DIR] [--allow MODULE]",
        description="Save all pictures of a stored trial in a folder, as PNG, SVG and GIF; "
        "or run a trial without storing it, and save its overview.",
    )
    parser.add_argument(
        "what", metavar="TRIAL | OUT.png", help="a trial's folder or its run in MLflow, or the file to write"
    )
    parser.add_argument(
        "more", nargs="*", metavar="FOLDER | override", help="overrides as of python -m simbias"
    )
    parser.add_argument(
        "--uri", default="sqlite:///mlflow.db", help="the trial's store (default: %(default)s)"
    )
    add_own_components(parser)
    return parser


def _stored(name: str, parsed: argparse.Namespace) -> TrialRecord:
    """The stored trial of a name."""
    return load_trial(name, parsed.uri, parsed.config_dir, parsed.allow)


def _draw_stored(name: str, folder: Path, parsed: argparse.Namespace) -> None:
    """Save all pictures of a stored trial."""
    trial = _stored(name, parsed)
    if not trial.iterations:
        raise ConfigError(name, "no iteration has ended, so there is nothing to draw")
    files = save_all(trial.study, trial.iterations, folder)
    print(f"{folder}: {', '.join(files)} of {trial.study.title}, seed {trial.study.seed}")


def _draw_new(out: str, parsed: argparse.Namespace) -> None:
    """Run a trial without storing it, and save its overview."""
    if not Path(out).parent.is_dir():
        raise ConfigError(out, "has to be in a folder that exists")
    study = load(parsed.more, parsed.config_dir, parsed.allow)
    save(overview(study, list(study.run())), out)
    print(f"{out}: {study.title}, seed {study.seed}")


if __name__ == "__main__":
    sys.exit(main())
