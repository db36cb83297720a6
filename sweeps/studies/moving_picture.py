"""README's moving picture: a trial's first policy on the hardware, beside its last.

`python sweeps/studies/moving_picture.py TRIAL OUT.gif`
"""

from __future__ import annotations

import argparse

import simbias
from simbias.core.messages import counted
from simbias.pictures.trial.animation import animate
from simbias.pictures.trial.comparison import (
    NamedRollout,
    first_and_last,
    on_hardware,
    policy_words,
    worst_experiment,
)


def moving_picture(trial: str, file: str) -> None:
    """Write a GIF of the worst experiments of both policies."""
    record = simbias.load_trial(trial)
    study, iterations = record.study, record.iterations
    both = first_and_last(on_hardware(iterations))
    named = [NamedRollout(policy_words(iteration), worst_experiment(study, iteration)) for iteration in both]
    count = counted(iterations[-1].total_experiments, "experiment")
    robot = study.choices["task"].replace("_", " ").capitalize()
    animate(study.task, named, f"{robot} on the hardware: {count} in all", file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial")
    parser.add_argument("file")
    arguments = parser.parse_args()
    moving_picture(arguments.trial, arguments.file)
