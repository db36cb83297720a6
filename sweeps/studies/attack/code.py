"""What might become code: targets, expressions, resolvers, Hydra's own keys."""

from __future__ import annotations

import json
import os
import random
import sys
from pathlib import Path

from attack.values import QUICK
from attack.verdict import HIT, Result, attempt

TOUCH = f"open('{HIT}', 'w')"
TARGETS = [
    *("os.system", "os.popen", "builtins.eval", "builtins.exec", "builtins.open", "subprocess.Popen"),
    *("subprocess.run", "functools.partial", "operator.methodcaller", "importlib.import_module"),
    *("pathlib.Path", "pickle.loads", "yaml.unsafe_load", "ctypes.CDLL", "webbrowser.open"),
    *("stranger.Stranger", "simbias.lab.requests.program.Program", "simbias.lab.requests.process.Process"),
    *("simbias.__main__.main", "simbias.core.files.Path"),
    *("simbias.lab.requests.verification.subprocess.run", "simbias.os.system"),
    *("simbias.simulation.compiler.compilation.exec", "simbias.config.own_code.sys"),
    *("simbias.mlflow.ui.webbrowser", "simbias.learning.bias.none.NoBias.__init__"),
    *("simbias.learning.bias.none.NoBias.__class__", "simbias.", "simbias..core", ".simbias.core"),
    *("simbias.core.Hardware", "simbias.engine.dask.Dask", "__main__.main", "simbias.terminal.new.new"),
    *("simbias.trial.study.Study", "simbias.config.allowed.find_spec", "os", "..", "ü.ü"),
]  # fmt: skip
EXTRAS = [
    {},
    {"_args_": [f"touch {HIT}"]},
    {"_partial_": True},
    {"_recursive_": False, "_convert_": "all"},
    {"command": f"touch {HIT}"},
    {"args": f"touch {HIT}", "shell": True},
    {"source": TOUCH},
    {"__init__": TOUCH},
    {"d": {"_target_": "os.system", "command": f"touch {HIT}"}},
]
EXPRESSIONS = [
    *(f"__import__('os').system('touch {HIT}')", TOUCH, f"(lambda: {TOUCH})()", f"[{TOUCH} for _ in [1]]"),
    *(f"exec(\"{TOUCH}\")", f"eval('{TOUCH}')", f"(x := {TOUCH})", f"f'{{{TOUCH}}}'", "angle.__class__"),
    *("angle.__class__.__base__.__subclasses__()", "sin.__globals__", "angle.tofile('HIT')"),
    *("sin(out=angle)", "np.save('HIT', angle)", "9**9**9**9", "10**10**8", "1e308 * 1e308"),
    *("angle ** angle ** angle", "1 / 0", "angle[0]", "angle[10**9]", "angle if angle else angle"),
    *("angle and angle", "not angle", "~angle", "angle < 1 < 2", "angle @ angle", "angle << 70"),
    *("'x' * 10**9", "[0] * 10**9", "(1,) * 10**9", "...", "sin()", "sin(1, 2)", "sin(*angle)"),
    *("sin(**angle)", "max()", "min(angle)", "atan2(angle)", "await angle", "yield", "import os", "a = 1"),
    *("angle; angle", "angle # x", "angle\n+ 1", "\x00", "", " ", "\uff41ngle"),
    *("(" * 300 + "angle" + ")" * 300, "+".join(["angle"] * 5000), "-" * 5000 + "angle"),
    *("sin(" * 150 + "1" + ")" * 150, "t", "force", "angle_error", "position_", "None", "True", "nan"),
    *("inf", "1j", "0x10", "1_0", "b''", "__debug__"),
]  # fmt: skip
PLACES = [
    "task.failure.falls.value",
    "task.failure.falls.above",
    "task.where.x",
    "task.outputs.z.value",
    "task.success.s.value",
    "task.goal.angle",
    "task.drawing.pole.thickness",
    "task.drawing.pole.grey",
    "cost.running",
    "cost.peak",
    "cost.final",
]
RESOLVERS = [
    *("${oc.env:HOME}", "${oc.create:{a: 1}}", "${oc.decode:'[1]'}", "${oc.decode:${oc.env:HOME}}"),
    *("${oc.select:seed}", "${oc.dict.keys:bias}", "${oc.deprecated:seed}", "${hydra:runtime.cwd}"),
    *("${now:%Y}", "${python:os}", "${eval:1+1}", "${oc.env:A,${oc.env:B,1}}"),
    *("${" * 100 + "seed" + "}" * 100, "${.}", "${..}"),
]  # fmt: skip
HYDRA = [
    *("hydra.searchpath=[pkg://os]", "hydra.searchpath=[file:///]", "hydra.searchpath=3"),
    *("hydra.run.dir=/tmp/x", f"hydra.callbacks={{x: {{_target_: os.system, command: 'touch {HIT}'}}}}"),
    *("hydra/launcher=basic", f"hydra.launcher={{_target_: os.system, command: 'touch {HIT}'}}"),
    *("hydra.sweeper=null", "hydra=x", "hydra.job.chdir=true", "hydra.mode=MULTIRUN"),
    *("hydra/job_logging=none", "hydra.output_subdir=/etc"),
    *("hydra.job_logging.handlers={a: {(): os.system, command: touch HIT}}", "~hydra"),
    *("hydra.verbose=[os]",),
]  # fmt: skip


def code(rng: random.Random, work: Path) -> list[Result]:
    """What asks to be run: nothing of it is, whether it is refused or not."""
    kind = rng.choice(["target", "target", "nested", "file", "expression", "expression", "resolver", "hydra"])
    target, extra = rng.choice(TARGETS), rng.choice(EXTRAS)
    given = {"_target_": target, **extra}
    expression, place = rng.choice(EXPRESSIONS), rng.choice(PLACES)
    group = rng.choice(["bias", "cost", "policy", "hardware", "nominal", "task", "tracking", "engine"])
    overrides, case = [f"{group}._target_={target}"], f"{group} {given}"
    if kind == "nested":
        key = rng.choice(
            ["bias.d", "hardware.noise", "hardware.safety", "evaluation.x", "policy_test", "sweep.x"]
        )
        overrides, case = [f"++{key}={_flow(given)}"], f"{key} {given}"
    elif kind == "file":
        overrides = [f"{group}=mine"]
    elif kind == "expression":
        case = f"{place}: {expression!r}"
        overrides = ["preset=cartpole", *(["cost=declared"] if place.startswith("cost") else []), "task=mine"]
        overrides += [f"cost={'mine' if place.startswith('cost') else 'cartpole'}"]
    elif kind == "resolver":
        key, text = rng.choice(["seed", "bias.d", "task.horizon", "hardware.noise"]), rng.choice(RESOLVERS)
        overrides, case = [f"{key}={text}"], f"{key}={text}"
    elif kind == "hydra":
        overrides = [rng.choice(HYDRA)]
        case = overrides[0]

    def prepare() -> None:
        conf = Path("beside", "conf")
        stranger = "import os\nopen(os.environ['HIT'], 'w')\nclass Stranger: pass\n"
        Path("stranger.py").write_text(stranger)  # not beside the folder of configs, but where Python looks
        sys.path.insert(0, "")
        os.environ["HIT"] = str(Path(HIT).absolute())
        for name in {group, "task", "cost"}:
            (conf / name).mkdir(parents=True, exist_ok=True)
        (conf / group / "mine.yaml").write_text(json.dumps(given))
        if kind == "expression":
            _declare(conf, place, expression)

    others = [each for each in QUICK[:3] if each.split("=")[0] != overrides[0].split("=")[0]]
    command = ["--config-dir", "beside/conf", "tracking=none", "engine=sequential", *others, *overrides]
    return [attempt("code", f"{kind}, {case}", command, prepare, work)]


def _flow(value: object) -> str:
    """A mapping as an override's value."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    escaped = str(value).replace("'", "\\'")
    return str(value).lower() if isinstance(value, bool) else f"'{escaped}'"


def _declare(conf: Path, place: str, expression: str) -> None:
    """A task and a cost with the expression at the place."""
    group, *keys = place.split(".")
    written: object = expression
    for key in reversed(keys):
        siblings = {"unit": "rad", "above": 0.2} if key == "value" and "falls" in keys else {}
        siblings |= {"below": 0.1} if key == "value" and "success" in keys else {}
        siblings |= {"value": "abs(angle)"} if key == "above" else {}
        written = {**siblings, key: written}
    contents: dict[str, object] = {"task": {"defaults": ["cartpole", "_self_"]}}
    contents["cost"] = {"defaults": ["declared", "_self_"]}
    contents[group] = {**contents[group], **written}  # type: ignore[dict-item]
    if "success" in keys:
        contents["task"] = {**contents["task"], "hold": 0.1}  # type: ignore[dict-item]
    for name, content in contents.items():
        (conf / name / "mine.yaml").write_text(json.dumps(content))
