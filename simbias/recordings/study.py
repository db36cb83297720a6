"""The study of an identification from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from simbias.config import compose
from simbias.config.build import NOT_OF_RECORDINGS, build
from simbias.config.components import component_class
from simbias.config.hydra_config import overridden
from simbias.core.errors import ConfigError
from simbias.core.messages import words
from simbias.learning.identification.posterior import Posterior
from simbias.trial.study import Study

GROUP = "identification"


def study_of(
    overrides: Sequence[str],
    config_dir: Path | str | None = None,
    allow: Sequence[str] = (),
    left_out: Sequence[str] = NOT_OF_RECORDINGS,
) -> Study:
    """The `prepared` study of these overrides, without the groups that are left out.

    `identification=posterior` is chosen if neither an override nor a preset does so.

    Raises
    ------
    ConfigError
        As for `simbias.load` and `prepared`.
    """
    identifying = _identifying(overrides, config_dir, allow)
    return prepared(build(compose(identifying, config_dir, allow, left_out), left_out))


def _identifying(overrides: Sequence[str], config_dir: Path | str | None, allow: Sequence[str]) -> list[str]:
    """The overrides, with an identification that is a posterior."""
    keys = overridden(overrides)
    if GROUP in keys:
        return [*overrides]
    # Without keys of the group, which may belong to the option that is still to be chosen.
    pairs = zip(overrides, keys, strict=True)
    others = [each for each, key in pairs if not key.startswith(f"{GROUP}.")]
    found = compose(others, config_dir, allow, NOT_OF_RECORDINGS)
    chosen = issubclass(component_class(found.config[GROUP], GROUP, found.own.modules), Posterior)
    return [*overrides, *([] if chosen else [f"{GROUP}=posterior"])]


def prepared(study: Study) -> Study:
    """The study for identification from recordings; it also tells what strong motion leaves undetermined.

    Raises
    ------
    ConfigError
        If it identifies no posterior, no parameter is uncertain, or the model has no such parameter.
    """
    study, posterior = study.without_targets, study.identification
    if not isinstance(posterior, Posterior):
        does = "identification=posterior does, and includes motor delays"
        raise ConfigError("identification", f"identifies no posterior; {does}")
    try:
        known = posterior.fit(study.nominal, [])
    except ValueError as error:
        raise ConfigError("", words(error)) from error
    if not known.parameters:
        raise ConfigError("nominal", "declares no uncertain parameters (nominal.uncertainty)")
    return replace(study, identification=posterior.of_recordings())
