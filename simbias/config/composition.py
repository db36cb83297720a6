"""From overrides to a plain, resolved config; what is wrong with them, in one line."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from simbias.config.allowed import NOTHING, Own, own, prefixes
from simbias.config.renamed import unknown
from simbias.config.resources import check_ends, check_no_primary, register_sweep, resource_folder, state
from simbias.core.errors import ConfigError, reason

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

OF_SWEEPS = ("engine", "sweep")  # groups that no trial knows
JOBS = ("env", "help", "hydra_help", "hydra_logging", "job_logging", "launcher", "output", "sweeper")
WITHOUT_JOBS = [f"hydra/{group}=[]" for group in JOBS]  # which Hydra runs none of here: a fourth of its time
NOT_HASHED = ("tracking", "experiment_timeout", "policy_test", *OF_SWEEPS)  # do not affect a trial's result


@dataclass(frozen=True)
class Composition:
    """A composed config: plain containers, interpolations resolved."""

    config: Mapping[str, Any]
    choices: Mapping[str, str]  # group -> chosen option
    own: Own = field(default=NOTHING, compare=False)  # what it may name of the user's
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
        """Identity of a trial: a hash of what affects its result."""
        return self.hash_with({})

    @cached_property
    def group_hash(self) -> str:
        """Identity of what repeated trials share: a hash of all but the seed."""
        from simbias.config.identity import sha

        return sha({key: value for key, value in self.identity_fields.items() if key != "seed"})

    def hash_with(self, changes: Mapping[str, Any]) -> str:
        """Identity of a trial with other values outside of components, as of its seed."""
        from simbias.config.identity import sha

        return sha({**self.identity_fields, **changes})

    @property
    def trial(self) -> Composition:
        """The part that concerns a single trial."""
        config = {key: value for key, value in self.config.items() if key not in OF_SWEEPS}
        choices = {key: option for key, option in self.choices.items() if key not in OF_SWEEPS}
        return replace(self, config=config, choices=choices)


def compose(
    overrides: Sequence[str] = (), config_dir: Path | str | None = None, allow: Sequence[str] = ()
) -> Composition:
    """Compose the config as Hydra does; `config_dir` is searched for groups, options and sweeps too.

    It may name classes of simbias, of modules beside `config_dir` and of those that `allow` names.

    Raises
    ------
    ConfigError
        If an override names an unknown key or option, or cannot be parsed or resolved.
    """
    return Variations(overrides, config_dir, allow).composition({})


class Variations:
    """Compositions that differ in a few settings, the same as if these were further overrides.

    Hydra composes once for each choice of options, which takes 100 ms; values are merged in a few.
    """

    def __init__(
        self,
        overrides: Sequence[str] = (),
        config_dir: Path | str | None = None,
        allow: Sequence[str] = (),
    ) -> None:
        if config_dir is not None and not os.path.isdir(config_dir):
            raise ConfigError("--config-dir", f"no such folder: {config_dir}")
        check_no_primary(config_dir)
        self.overrides = list(overrides)
        self._config_dir = None if config_dir is None else str(Path(config_dir).resolve())
        self._folders = [] if config_dir is None else [Path(config_dir)]
        self._allowed = prefixes(self._folders, allow)

    def composition(self, settings: Mapping[str, Any]) -> Composition:
        """The composition with options (`bias`), values (`bias.d`) and new values (`+hardware.noise.x`) set.

        Raises
        ------
        ConfigError
            As `compose` does.
        """
        from hydra.errors import HydraException
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # Hydra only warns of a search path that does not exist
                structure, changes = self._split
                groups = self._compose(structure).choices if settings else {}
                options = [f"{key}={value}" for key, value in settings.items() if key in groups]
                composed = self._compose([*structure, *options])
                values = changes | {key: value for key, value in settings.items() if key not in groups}
                config = composed.config.copy() if values else composed.config
                for key, value in values.items():
                    _set(config, key, value)
                plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
        except ConfigError:
            raise
        except (HydraException, OmegaConfBaseException, UserWarning) as error:
            raise _in_one_line(error) from error
        except Exception as error:  # of a file or a value; Hydra raises others than its own, too
            raise ConfigError(" ".join(self.overrides), reason(error)) from error
        theirs = own(plain, self._folders, self._allowed)
        return Composition(plain, dict(composed.choices), theirs, tuple(_from_environment(config)))

    @cached_property
    def _split(self) -> tuple[list[str], dict[str, Any]]:
        """The overrides that Hydra composes, and those that change values of what it composed.

        Where one adds or deletes a key, all are Hydra's: their order counts.
        """
        from hydra.core.override_parser.types import OverrideType

        folders = [resource_folder("conf"), *self._folders]
        structure: list[str] = []
        values: dict[str, Any] = {}
        for text, each in zip(self.overrides, _parsed(self.overrides), strict=True):
            key = each.key_or_group
            changes = each.type is OverrideType.CHANGE and not each.is_sweep_override() and not each.package
            if "/" in key or any((folder / key).is_dir() for folder in folders) or key == "sweep":
                structure.append(text)
            elif changes and not key.startswith("hydra."):
                values[key] = each.value()
            else:
                return self.overrides, {}
        return structure, values

    def _compose(self, overrides: Sequence[str]) -> _Composed:
        """Hydra's work: once for each choice of options, while no file changes."""
        files = state([resource_folder("conf"), resource_folder("sweeps"), *map(Path.resolve, self._folders)])
        return _composed(tuple(overrides), self._config_dir, files)


def _from_environment(config: DictConfig) -> Iterator[str]:
    """The keys of what is written down whose values come from environment variables."""
    from omegaconf import OmegaConf

    groups: Any = OmegaConf.to_container(config, resolve=False)
    waiting = [(str(key), value) for key, value in groups.items() if key != "tracking"]
    for key, value in waiting:
        if isinstance(value, dict | list):
            parts = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [(f"{key}.{part}", each) for part, each in parts]
        elif "${oc.env:" in str(value):
            yield key


class _Composed(NamedTuple):
    """A composition by Hydra."""

    config: DictConfig  # interpolations not yet resolved
    choices: Mapping[str, str]


@lru_cache(maxsize=2000)
def _composed(overrides: Sequence[str], config_dir: str | None, files: frozenset) -> _Composed:
    """Hydra's composition, which takes 40 ms; `files` is the state of what it reads."""
    import hydra
    from omegaconf import OmegaConf

    if config_dir is not None:
        for file in (Path(path) for path, *_ in files):
            if file.is_relative_to(config_dir):
                check_ends(file)
        overrides = [*overrides, f"hydra.searchpath=[{_quoted(f'file://{config_dir}')}]"]
    values = {each.key_or_group: each.value() for each in _parsed(overrides)}  # the last of each
    if isinstance(sweep := values.get("sweep"), str):
        register_sweep(sweep, config_dir)
    with hydra.initialize_config_dir(str(resource_folder("conf")), version_base="1.3"):
        composed = hydra.compose("config", [*WITHOUT_JOBS, *overrides], return_hydra_config=True)
    runtime: dict[str, str] = dict(composed.hydra.runtime.choices)
    choices = {group: option for group, option in runtime.items() if not group.startswith("hydra/")}
    if isinstance(presets := values.get("preset"), list):  # of which Hydra does not tell
        choices["preset"] = ",".join(map(str, presets))
    own = OmegaConf.masked_copy(composed, [str(key) for key in composed if key != "hydra"])
    OmegaConf.set_struct(own, True)
    return _Composed(own, choices)


def _set(config: DictConfig, key: str, value: Any) -> None:
    """Set a value; a key that the config lacks begins with +."""
    from omegaconf import OmegaConf
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError

    try:
        OmegaConf.update(config, key.removeprefix("+"), value, force_add=key.startswith("+"))
    except (ConfigAttributeError, ConfigKeyError) as error:
        raise _no_such_key(key) from error


def overridden(overrides: Sequence[str]) -> list[str]:
    """The keys and groups that overrides set or delete.

    Raises
    ------
    ConfigError
        If one cannot be parsed.
    """
    from hydra.errors import HydraException

    try:
        return [each.key_or_group for each in _parsed(overrides)]
    except HydraException as error:
        raise _in_one_line(error) from error
    except RecursionError as error:
        raise ConfigError(" ".join(overrides), reason(error)) from error


def _quoted(text: str) -> str:
    """Text quoted as a value of an override, whichever characters it has."""
    escaped = text.replace("'", "\\'")
    return f"'{escaped}'"


def _parsed(overrides: Sequence[str]) -> list[Override]:
    """The overrides as Hydra parses them."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_overrides(list(overrides))


def _in_one_line(error: Exception) -> ConfigError:
    """Hydra's and OmegaConf's multi-line errors, as one line that names the key."""
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        choice = f"{group}={option}"
        return unknown([choice], choice, f"no such option; {group} has {', '.join(error.options)}")
    cause = error.__cause__
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return _no_such_key(str(error).split("'")[1])
    lines = [line.strip().removesuffix(".") for line in str(error).splitlines() if "hydra.cc" not in line]
    if isinstance(error, OverrideParseException):
        said = "" if lines[0].startswith("Lexer") else f" ({lines[:2][-1]})"  # else it is the override again
        return ConfigError(error.override, f"cannot be parsed{said}; quotes keep a value together")
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return ConfigError(error.full_key, lines[0])
    return unknown(re.findall("'(.+?)'", lines[0]), "", ": ".join(lines[:2]))


def _no_such_key(key: str) -> ConfigError:
    """The error of a key that the config has not."""
    if key.startswith("sweep."):
        return unknown([key], key, f"no such key; +{key}=... if the sweep's file only leaves it out")
    return unknown([key], key, "no such key; --cfg job shows them all, --help the groups")
