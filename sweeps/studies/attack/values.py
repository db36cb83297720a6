"""Values at every key, and forms of overrides, options and sweeps."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from simbias.config import options, sweeps
from simbias.config.resources import resource_folder

QUICK = [
    "task.horizon=200",
    "optimizer.max_evaluations=20",
    "method.max_iterations=1",
    "tracking.pictures=false",
]
NUMBERS = [
    *(
        "0",
        "-0.0",
        "1",
        "-1",
        "2",
        "0.1",
        "1e-9",
        "1e-300",
        "5e-324",
        "1e9",
        "1e15",
        "1e300",
        "1e308",
        "-1e308",
    ),
    *("nan", "inf", "-inf", str(2**31), str(2**63), str(2**64), str(10**18), str(10**30), "9" * 5000),
    *("0x10", "1_000", "1e", "0.1.2", "1e5000", "01", "+3"),
]
TYPES = [
    *(
        "null",
        "true",
        "off",
        "''",
        "[]",
        "[1]",
        "{}",
        "{a: 1}",
        "[nan]",
        "[[1]]",
        "[null]",
        "{1: [2]}",
        "[a,b]",
    ),
    *("[0,0,0,0,0,0]", "[1e300,0,0,0,0,0]", "[0,0,0,0,0,0,0]", "[true]", "[inf]", "{_target_: os.system}"),
    *("[" * 60 + "]" * 60, "[" * 2000 + "]" * 2000, "{a: " * 300 + "1" + "}" * 300, "[" + "1," * 3000 + "1]"),
    "{_target_: simbias.learning.bias.none.NoBias}",
]
TEXTS = [
    *(
        "x",
        "ü",
        "'\u202e'",
        "'\U0001f916'",
        "'a b'",
        "x" * 300,
        "'" + "x" * 5000 + "'",
        "'%s%n'",
        "'{0}'",
        "\udce9",
    ),
    *(
        "${oc.env:HOME}",
        "${hardware}",
        "${a.b}",
        "${seed}",
        "${oc.env:NOWHERE}",
        "${${seed}}",
        "???",
        "../..",
        "/dev/null",
    ),
    *(
        "'\n'",
        "'\t'",
        "'\x1b[31m'",
        "'a\\'b'",
        '"',
        "'",
        "(",
        "sweep(1,2)",
        "choice(a,b)",
        "range(1,10)",
        "glob(*)",
    ),
    *(
        "!!python/object:os.system",
        "int(3)",
        "str([1])",
        "a,b",
        "a=b",
        "--help",
        "@file",
        "'|'",
        "'[red]'",
        "<b>",
    ),
]
VALUES = [*NUMBERS, *TYPES, *TEXTS]
SWEEPS = [
    *("{}", "null", "3", "{trials: 1}", "{axes: {}}", "{trials: 0, axes: {}}", "{trials: -1, axes: {}}"),
    *("{trials: 1, axes: []}", "{trials: 1, axes: {bias: gp}}", "{trials: 1, axes: {bias: []}}"),
    *(
        "{trials: 1, axes: {bias: [gp, gp]}}",
        "{trials: 1, axes: {bias: [nothing]}}",
        "{trials: 1, axes: {'a b': [1]}}",
    ),
    *(
        "{trials: 1, axes: {bias.d: [{a: 1}]}}",
        "{trials: 1, axes: {seed: [1, 2]}}",
        "{trials: 1, axes: {outcome: [1]}}",
    ),
    *(
        "{trials: 1, axes: {x: {keys: [bias.d], values: [[1]], labels: [a, b]}}}",
        "{trials: 1, axes: {'': [1]}}",
    ),
    *("{trials: 1, axes: {x: {keys: [], values: [[]]}}}", "{trials: 1, axes: {}, figures: {f: {}}}"),
    *(
        "{trials: 1, axes: {}, figures: {f: {_target_: os.system}}}",
        "{trials: 1, axes: {}, report: {columns: x}}",
    ),
    *(
        "{trials: 1, axes: {}, unknown: 1}",
        "{trials: 1, axes: {}, common_seeds: [bias]}",
        "{trials: 1e300, axes: {}}",
    ),
    *(
        "{trials: 1, axes: {bias.d: [nan, inf]}}",
        "{trials: 1, axes: {'\U0001f916': [1]}}",
        "{trials: 1, axes: {}, dry_run: 3}",
    ),
    "{trials: 1, axes: {" + "x" * 300 + ": [1]}}",
]


@cache
def keys() -> dict[str, tuple[str, Any]]:
    """Every key of every option: what chooses it, and its shipped value."""
    found: dict[str, tuple[str, Any]] = {}
    for group, names in options().items():
        for name in names:
            node = OmegaConf.load(resource_folder("conf") / group / f"{name}.yaml")
            for key, value in _leaves(OmegaConf.to_container(node), f"{group}."):
                found[f"{group}={name} {key}"] = (f"{group}={name}", value)
    for key in ("seed", "experiment_timeout"):
        found[key] = ("bias=gp", 1)
    return found


def _leaves(node: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Dotted keys and values, those of mappings too."""
    for key, value in node.items():
        yield f"{prefix}{key}", value
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")


def _near(value: Any, rng: random.Random) -> str:
    """A value like the shipped one: another size, another length."""
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return rng.choice(VALUES)
    if isinstance(value, int | float):
        scaled = value * 10.0 ** rng.uniform(-12, 12) * rng.choice([1, 1, 1, -1])
        return str(round(scaled)) if isinstance(value, int) else f"{scaled:.3g}"
    if isinstance(value, list) and value:
        several = [_near(each, rng) for each in value]
        return f"[{','.join(several + several[:1] if rng.random() < 0.2 else several)}]"
    return rng.choice(VALUES)


def value_case(rng: random.Random) -> tuple[str, list[str], str]:
    """A value at a key, the command that gives it, and the key."""
    name, (choice, value) = rng.choice(sorted(keys().items(), key=lambda item: item[0]))
    key = name.rpartition(" ")[2]
    given = _near(value, rng) if rng.random() < 0.4 else rng.choice(VALUES)
    form = rng.choices(["{}={}", "++{}={}", "+{}={}", "~{}", "{}.x={}", "{}@here={}"], [20, 2, 1, 1, 1, 1])[0]
    override = form.format(key, given)
    store = [] if key.startswith("tracking") else ["tracking=none"]
    if key.startswith("tracking"):  # no pictures of what nobody looks at
        store = []
    quick = [each for each in QUICK if each.partition("=")[0] != key and not (store and "tracking" in each)]
    return f"{choice} {override}", [choice, *store, *quick, override], key


def form_case(rng: random.Random) -> tuple[str, list[str]]:
    """A strange option, sweep or flag, and the command that gives it."""
    groups = [*options(), "sweep", "nothing"]
    text = rng.choice(VALUES)
    kind = rng.randrange(6)
    if kind == 0:
        override = f"{rng.choice(groups)}={text}"
    elif kind == 1:
        override = f"+sweep={rng.choice(SWEEPS)}"
    elif kind == 2:
        name, (_, _) = rng.choice(sorted(keys().items(), key=lambda item: item[0]))
        values = ",".join(rng.sample([*NUMBERS[:-7], *TYPES[:14]], rng.randint(1, 3)))
        axes = f"{{{name.rpartition(' ')[2]}: [{values}]}}"
        override = f"+sweep={{trials: 1, dry_run: {rng.choice(['true', 'false'])}, axes: {axes}}}"
    elif kind == 3:
        override = rng.choice([text, f"{text}=1", f"+{text}={text}", f"~{text}", f"{text}@{text}={text}"])
    elif kind == 4:
        key = rng.choice(
            ["trials", "axes", "dry_run", "report", "figures", "common_seeds", "figures_to", "unknown"]
        )
        more = [f"sweep.{key}={text}", "tracking=none", "engine=sequential", *QUICK[:3]]
        name = rng.choice([name for name in sweeps() if name == "smoke"])
        return f"+sweep={name} sweep.{key}={text}", [f"+sweep={name}", *more]
    else:
        flag = rng.choice(["--config-dir", "--allow", "--cfg", "--unknown", "check"])
        return f"{flag} {text}", [flag, text, "tracking=none", *QUICK[:3]]
    others = ["tracking=none", "engine=sequential", *QUICK[:3]]  # but for what a later one would replace
    return override, [override, *(each for each in others if each.split("=")[0] != override.split("=")[0])]
