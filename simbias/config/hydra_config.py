"""A config composed by Hydra from overrides, with one-line errors."""

from __future__ import annotations

import pickle
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from simbias.config.components import NEAR, PROVIDED, component_class, constructor_parameters
from simbias.config.renamed import unknown
from simbias.config.resources import forget_sweeps, register_sweep, resource_folder
from simbias.core.errors import ConfigError, check_list, reason

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

JOBS = ("env", "help", "hydra_help", "hydra_logging", "job_logging", "launcher", "output", "sweeper")
WITHOUT_JOBS = [f"hydra/{group}=[]" for group in JOBS]  # no jobs run here; saves a fourth of Hydra's time

ONE_OPTION = "takes one option; only preset takes several"
HINTS = {"identification": "; a posterior has delays, too: identification.motors={NAME: {delay: 0.01}}"}
UNMERGED = "Cannot merge DictConfig with ListConfig"  # OmegaConf's words, whichever is the list
FILES = "preset/", "sweep/"  # of options and keys of all groups
IN_A_FILE = r"Multiple values for (\w+)|'(?:preset|sweep)/(\w+)@|'\w+@preset\.(\w+)'"
OVERRIDE = (
    "; in the defaults of a preset or a sweep, write 'override /{}: {}'. A preset's first line is "
    "'# @package _global_'"
)
SEVERAL = "has several values; put a list in brackets, or run many trials as a sweep (+sweep=NAME)"


class Composed(NamedTuple):
    """A composition by Hydra."""

    config: Callable[[], Any]  # makes a copy with unresolved interpolations
    choices: Mapping[str, str]


@lru_cache(maxsize=2000)
def composed(overrides: Sequence[str], config_dir: str | None, grid: bool, files: frozenset) -> Composed:
    """Hydra's composition, with or without the grid; `files` is the state of the files it reads."""
    import hydra
    from omegaconf import OmegaConf, open_dict

    from simbias.config import option_files  # lazily: Hydra takes a tenth of a second

    option_files.register()
    OmegaConf.register_new_resolver("noise_of_hardware", _noise_of_hardware, replace=True)
    if config_dir is not None:
        escaped = config_dir.replace("'", "\\'")
        overrides = [*overrides, f"hydra.searchpath=['{option_files.SCHEME}://{escaped}']"]
    given = parsed(overrides)
    values = {each.key_or_group: each.value() for each in given}  # the last value of each
    if (
        len({str(each.value()) for each in given if each.key_or_group == "preset" and not each.is_delete()})
        > 1
    ):
        raise ConfigError("preset", "is given twice; 'preset=[cartpole,robust]' combines two")
    folders = [resource_folder("conf"), *([] if config_dir is None else [Path(config_dir)])]
    for group, value in values.items():
        if isinstance(value, list) and group != "preset" and any((each / group).is_dir() for each in folders):
            raise ConfigError(group, f"{ONE_OPTION}{HINTS.get(group, '')}")
    try:
        if isinstance(sweep := values.get("sweep"), str):
            register_sweep(sweep, config_dir, grid)
        with hydra.initialize_config_dir(str(resource_folder("conf")), version_base="1.3"):
            config = _by_hydra(_opened(given))
    finally:
        forget_sweeps()
    runtime: dict[str, str] = dict(config.hydra.runtime.choices)
    choices = {group: option for group, option in runtime.items() if not group.startswith("hydra/")}
    if isinstance(presets := values.get("preset"), list):  # not reported by Hydra
        choices["preset"] = ",".join(map(str, presets))
    with open_dict(config):
        del config["hydra"]
    OmegaConf.set_struct(config, True)
    return Composed(copies(config), choices)


def copies(original: object) -> Callable[[], Any]:
    """A function that makes copies of an object, several times faster than OmegaConf's own."""
    return partial(pickle.loads, pickle.dumps(original))  # which never leave the process


def _noise_of_hardware(*, _root_: DictConfig) -> Any:
    """Variances declared by the hardware; a custom class may use the name for a number."""
    from omegaconf import OmegaConf

    declared = OmegaConf.select(_root_, "hardware.noise")
    return declared if OmegaConf.is_dict(declared) else {}


def set_value(config: DictConfig, key: str, value: Any) -> None:
    """Set a value; a new key begins with +, or is part of a whole mapping."""
    from omegaconf import OmegaConf
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError

    whole, _, part = key.rpartition(".")
    held = OmegaConf.select(config, whole, throw_on_resolution_failure=False) if whole else None
    if OmegaConf.is_list(held) and not re.fullmatch(r"-?\d+", part):
        raise ConfigError(whole, f"is a list: {whole}.0=... sets its first value")
    try:
        opened = _is_whole(key, value) and OmegaConf.select(config, key) is not None
        force_add = key.startswith("+") or opened
        OmegaConf.update(config, key.removeprefix("+"), value, force_add=force_add)
    except (ConfigAttributeError, ConfigKeyError) as error:
        raise _no_such_key(key, held) from error


def check_overrides(overrides: Any) -> None:
    """Raise ConfigError unless these are a list of texts."""
    check_list("overrides", overrides, str, "texts such as 'seed=3'")


def overridden(overrides: Sequence[str]) -> list[str]:
    """The keys and groups that overrides set or delete; a ConfigError if one cannot be parsed."""
    check_overrides(overrides)
    with errors_in_one_line(overrides):
        return [each.key_or_group for each in parsed(overrides)]


def _by_hydra(lines: Sequence[str]) -> DictConfig:
    """Hydra's config of overrides."""
    import hydra

    return hydra.compose("config", [*WITHOUT_JOBS, *lines], return_hydra_config=True)


def _opened(given: Sequence[Override]) -> list[str]:
    """Overrides as lines; those that set an existing mapping may also add keys to it."""
    from omegaconf import OmegaConf

    lines = [(str(each.input_line), each.key_or_group, each.value()) for each in given]
    whole = {line: key for line, key, value in lines if line.startswith(key) and _is_whole(key, value)}
    beside: Any = _by_hydra([line for line, *_ in lines if line not in whole]) if whole else None
    return [
        f"+{line}" if line in whole and OmegaConf.select(beside, key) is not None else line
        for line, key, _ in lines
    ]


def _is_whole(key: str, value: Any) -> bool:
    """Whether a whole mapping is set, as in `hardware.noise={force_variance: 0.1}`."""
    return isinstance(value, Mapping) and "." in key and not key.startswith("sweep.")


def parsed(overrides: Sequence[str]) -> list[Override]:
    """The overrides as Hydra parses them."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_overrides(list(overrides))


@contextmanager
def errors_in_one_line(overrides: Sequence[str]) -> Iterator[None]:
    """Convert errors of Hydra, OmegaConf and the system to one line that names the key or the overrides."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Hydra only warns of a search path that does not exist
            yield
    except ConfigError:
        raise
    except (HydraException, OmegaConfBaseException, UserWarning) as error:
        raise _in_one_line(error) from error
    except Exception as error:  # of a file or a value; Hydra also raises other types
        raise ConfigError(" ".join(overrides), reason(error)) from error


def _in_one_line(error: Exception) -> ConfigError:
    """Hydra's and OmegaConf's multi-line errors, as one line that names the key."""
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import (
        ConfigAttributeError,
        ConfigKeyError,
        InterpolationKeyError,
        OmegaConfBaseException,
    )

    in_a_list = str(error).startswith("In 'config'")  # an error in presets, for which Hydra lists no options
    if isinstance(error, MissingConfigException) and (error.options is not None or in_a_list):
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        choice = f"{group}={option}"
        there = f"; {group} has {', '.join(error.options)}" if error.options else ""
        if group.startswith(FILES):
            there = OVERRIDE.format(group.partition("/")[2], option)
        return unknown([choice], choice, f"no such option{there}")
    if found := re.search(IN_A_FILE, str(error)):
        said, group = str(error).splitlines()[0].partition(". ")[0], found[found.lastindex or 0]
        return ConfigError("", said.rstrip(".") + OVERRIDE.format(group, "OPTION"))
    cause = error.__cause__
    for each in (error, cause):
        if UNMERGED in str(each):
            return _unmerged(each)
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return _no_such_key(str(error).split("'")[1])
    lines = [line.strip().removesuffix(".") for line in str(error).splitlines() if "hydra.cc" not in line]
    if isinstance(error, OverrideParseException) and "missing EQUAL" in str(error):
        return ConfigError(error.override, "expected group=option or group.key=value, such as preset=robust")
    if isinstance(error, OverrideParseException):
        said = "" if lines[0].startswith("Lexer") else f" ({lines[:2][-1]})"  # else it repeats the override
        of_ours = "put an expression in quotes, as in {x: 'sin(t)'}" if "Unknown function" in said else ""
        return ConfigError(error.override, f"cannot be parsed{said}; {of_ours or 'put the value in quotes'}")
    quoted = re.findall("'(.+?)'", lines[0])
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        if isinstance(error, InterpolationKeyError):
            lines[0] = f"refers to {quoted[0]}, which is missing; is this option for another robot?"
        return ConfigError(error.full_key, lines[0])
    if lines[0].startswith(("Sweep parameters", "Ambiguous value")):
        return ConfigError(quoted[0], SEVERAL)
    return unknown(quoted, "", ": ".join(lines[:2]))


def _unmerged(error: BaseException | None) -> ConfigError:
    """The error for a mapping given for a list, or a list for a mapping."""
    if key := getattr(error, "full_key", None):
        held, given = ("list", "mapping") if "object_type=list" in str(error) else ("mapping", "list")
        remedy = f"give a {held}, or delete it first: '~{key}' '+{key}=...'"
        return ConfigError(key, f"is a {held}, into which no {given} can be merged; {remedy}")
    file = re.findall("'(.+?)'", str(error))[:1]
    both = "gives a mapping for a list that it inherits, or a list for a mapping"
    return ConfigError("".join(file), f"{both}; write it in full, without the file from which it inherits")


def _no_such_key(key: str, component: Any = None) -> ConfigError:
    """The error for a key that the config lacks, perhaps of a shipped component with this config."""
    of_an_axis = re.search(r"\.(keys|values|labels|only)$|\.points(\.|$)", key)
    if re.match(r"sweep\.axes(\.|$)", key) and not of_an_axis:
        axis = key[len("sweep.axes.") :] or "NAME"
        adds = f"'+sweep.axes={{{axis}: [...]}}' sets or adds an axis"
        return ConfigError(key, f"no such key; {adds}; an axis has keys, values, labels, points and only")
    if key.startswith("sweep."):
        return unknown([key], key, f"no such key; +{key}=... sets one that the sweep's file leaves out")
    if key.startswith("hardware.noise."):
        sets = "+hardware.noise.NAME_variance=... sets the variance of a quantity or kind of the robot"
        return unknown([key], key, f"no such key; {sets}")
    group, _, name = key.partition(".")
    with suppress(ConfigError):  # of a component whose module is not simbias's
        made = component_class(component, group)
        names = constructor_parameters(made).keys() - PROVIDED
        names |= {"confirm", "safety"} if group == "hardware" else set()
        if name not in names:
            near = get_close_matches(name, names, 1, NEAR)
            has = f"{made.__name__} takes {', '.join(sorted(names)) or 'none'}"
            return unknown([key], key, f"no such key; {f'did you mean {near[0]}?' if near else has}")
    left_out = f"; +{key}=... sets one that the config leaves out" if "." in key else ""
    return unknown([key], key, f"no such key; --cfg job shows all keys, --help the groups{left_out}")
