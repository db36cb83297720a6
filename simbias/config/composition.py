"""From overrides to a plain, resolved config, with one-line errors."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from simbias.config.allowed import NOTHING, Own, leaves, own, prefixes
from simbias.config.hydra_config import check_overrides, composed, errors_in_one_line, parsed, set_value
from simbias.config.resources import check_no_primary, resource_folder, state
from simbias.core.digest import short_digest
from simbias.core.errors import ConfigError, check_list
from simbias.core.ranges import Seed

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

SCHEME = 2  # of identities: incremented when all of them change
OF_SWEEPS = ("engine", "sweep")  # groups that do not belong to a trial
NOT_HASHED = ("tracking", "experiment_timeout", "policy_test", *OF_SWEEPS)  # do not affect a trial's result


@dataclass(frozen=True)
class Composition:
    """A composed config: plain containers with resolved interpolations."""

    config: Mapping[str, Any]
    choices: Mapping[str, str]  # group -> chosen option
    own: Own = field(default=NOTHING, compare=False)  # the user's own code and files that it may name
    from_environment: tuple[str, ...] = field(default=(), compare=False)  # keys whose values may be secrets

    @cached_property
    def identity_fields(self) -> Mapping[str, Any]:
        """The config as far as it affects a trial's result (`simbias.config.identity`)."""
        from simbias.config.identity import identity_fields  # lazily: --help needs no components

        return identity_fields(self.config, NOT_HASHED, self.own.modules)

    @property
    def code(self) -> Mapping[str, str]:
        """Digests of the user's own modules; the components have been built (`simbias.config.own_code`)."""
        from simbias.config.own_code import digests

        return digests(self.config)

    @cached_property
    def hash(self) -> str:
        """Identity of a trial: a hash of everything that affects its result."""
        return self.hash_with({})

    @cached_property
    def group_hash(self) -> str:
        """Identity shared by repeated trials: a hash of everything except the seed."""
        return _sha({key: value for key, value in self.identity_fields.items() if key != "seed"})

    def hash_with(self, changes: Mapping[str, Any]) -> str:
        """Identity of a trial with other values outside of components, such as its seed."""
        return _sha({**self.identity_fields, **changes})

    @property
    def trial(self) -> Composition:
        """The part that concerns a single trial."""
        config = {key: value for key, value in self.config.items() if key not in OF_SWEEPS}
        choices = {key: option for key, option in self.choices.items() if key not in OF_SWEEPS}
        return replace(self, config=config, choices=choices)


def compose(
    overrides: Sequence[str] = (),
    config_dir: Path | str | None = None,
    allow: Sequence[str] = (),
    left_out: Sequence[str] = (),
) -> Composition:
    """Compose the config with Hydra; `config_dir` is also searched for groups, options and sweeps.

    It may name classes of simbias, of modules beside `config_dir` and of modules in `allow`. Groups that are
    `left_out` are not resolved.

    Raises
    ------
    ConfigError
        If an override names an unknown key or option, or cannot be parsed or resolved.
    """
    return Variations(overrides, config_dir, allow).composition({}, left_out)


class Variations:
    """Compositions that differ in a few settings, as if these were additional overrides.

    Hydra composes once for each choice of options, which takes 60 ms; values are merged in a few.
    """

    def __init__(
        self,
        overrides: Sequence[str] = (),
        config_dir: Path | str | None = None,
        allow: Sequence[str] = (),
    ) -> None:
        if config_dir is not None:
            if not os.path.isdir(config_dir):
                raise ConfigError("--config-dir", f"no such folder: {config_dir}")
            check_no_primary(Path(config_dir))
        check_overrides(overrides)
        check_list("allow", allow, str, "modules")
        # A dry run needs no + if a sweep's file lacks the key.
        self.overrides = [re.sub(r"^\+{0,2}(?=sweep\.dry_run=)", "++", each) for each in overrides]
        self._config_dir = None if config_dir is None else str(Path(config_dir).resolve())
        self._folders = [] if config_dir is None else [Path(config_dir)]
        self._allowed = prefixes(self._folders, allow)
        self._read = [resource_folder("conf"), *map(Path.resolve, self._folders)]

    def composition(self, settings: Mapping[str, Any], left_out: Sequence[str] = ()) -> Composition:
        """The composition with options (`bias`), values (`bias.d`) and new values (`+hardware.noise.x`) set.

        Groups left out, and errors, as for `compose`.
        """
        with errors_in_one_line(self.overrides):
            config, choices = self._merged(self._split, settings, grid=True)
            return self._finished(config, choices, _from_environment(config), left_out)

    def trial(self, settings: Mapping[str, Any]) -> Composition:
        """The part of this composition that concerns a single trial; errors as for `compose`.

        The grid may be larger than everything else, so it is neither composed nor copied again.
        """
        from omegaconf import flag_override

        with errors_in_one_line(self.overrides):
            config, choices = self._merged(self._split_of_trials, settings, grid=False)
            secret = _from_environment(config)
            with flag_override(config, ["struct", "no_deepcopy_set_nodes"], [False, True]):
                config["sweep"] = self._grid  # for interpolations that refer to it
            return self._finished(config, choices, secret, OF_SWEEPS)

    def _merged(
        self, split: _Split, settings: Mapping[str, Any], grid: bool
    ) -> tuple[DictConfig, Mapping[str, str]]:
        """The config with unresolved interpolations, and the choices of groups."""
        by_hydra = partial(composed, config_dir=self._config_dir, grid=grid, files=self._files)
        groups = by_hydra(tuple(split.structure)).choices if settings else {}
        options = [f"{key}={value}" for key, value in settings.items() if key in groups]
        whole = by_hydra((*split.structure, *options))
        config = whole.config()
        further = ((key, value) for key, value in settings.items() if key not in groups)
        for key, value in (*split.values, *further):
            set_value(config, key, value)
        return config, whole.choices

    def _finished(
        self,
        config: DictConfig,
        choices: Mapping[str, str],
        from_environment: tuple[str, ...],
        left_out: Sequence[str] = (),
    ) -> Composition:
        """The composition in plain containers, without some groups."""
        from omegaconf import OmegaConf

        from simbias.config.components import validate  # lazily, as above

        values: dict[str, Any] = {str(key): config[key] for key in config if key not in left_out}
        plain = {
            key: OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
            if OmegaConf.is_config(value)
            else value
            for key, value in values.items()
        }
        if "seed" in plain:  # normalise 1, 01, 1e0 and '1', since seeds distinguish trials
            plain |= validate({"seed": plain["seed"]}, {"seed": Seed}, "")
        chosen = {group: option for group, option in choices.items() if group not in left_out}
        return Composition(plain, chosen, own(plain, self._folders, self._allowed), from_environment)

    @cached_property
    def _files(self) -> frozenset:
        """The state of all files that Hydra reads."""
        return state(self._read)

    @cached_property
    def _grid(self) -> DictConfig | None:
        """The node `sweep`, which trials share."""
        return self._merged(self._split, {}, grid=True)[0].get("sweep")

    @cached_property
    def _split(self) -> _Split:
        """The overrides, split."""
        return self._split_up(self.overrides)

    @cached_property
    def _split_of_trials(self) -> _Split:
        """The overrides that concern a trial, split."""
        pairs = zip(self.overrides, parsed(self.overrides), strict=True)
        return self._split_up([text for text, each in pairs if not _is_of_the_grid(each)])

    def _split_up(self, overrides: Sequence[str]) -> _Split:
        """Split into overrides for Hydra, and those that change values in Hydra's result.

        If one adds or deletes a key, all go to Hydra, as their order matters.
        """
        from hydra.core.override_parser.types import OverrideType

        structure: list[str] = []
        values: list[tuple[str, Any]] = []
        for text, each in zip(overrides, parsed(overrides), strict=True):
            key = each.key_or_group
            changes = each.type is OverrideType.CHANGE and not each.is_sweep_override() and not each.package
            if "/" in key or any((folder / key).is_dir() for folder in self._read) or key == "sweep":
                structure.append(text)
            elif changes and not key.startswith("hydra."):
                values.append((key, each.value()))
            else:
                return _Split(overrides, [])
        return _Split(structure, values)


class _Split(NamedTuple):
    """Overrides by who handles them."""

    structure: Sequence[str]  # handled by Hydra
    values: Sequence[tuple[str, Any]]  # set in this order in Hydra's result


def _sha(fields: Mapping[str, Any]) -> str:
    """The first hexadecimal digits of a SHA-256 of these fields and of the scheme."""
    text = json.dumps({"scheme": SCHEME, **fields}, sort_keys=True)
    return short_digest(text.encode())


def _is_of_the_grid(override: Override) -> bool:
    """Whether an override concerns the grid, not a trial; a sweep's file concerns both."""
    key, within, _ = override.key_or_group.partition(".")
    return key == "sweep" and (bool(within) or not isinstance(override.value(), str))


def _from_environment(config: DictConfig) -> tuple[str, ...]:
    """The stored keys whose values come from environment variables."""
    from omegaconf import OmegaConf

    found = leaves(OmegaConf.to_container(config, resolve=False))
    paths = (path for path, value in found if path[0] != "tracking" and "${oc.env:" in str(value))
    return tuple(".".join(map(str, path)) for path in paths)
