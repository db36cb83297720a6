"""Bad input, and what had another name before, ends in one line that names the key, before anything runs."""

import pickle
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import pytest
from errors import one_line
from omegaconf import OmegaConf
from shipped import shipped
from texts import write

import simbias
from simbias.config import ConfigError, compose, options
from simbias.config.components import component_class, constructor_parameters
from simbias.config.conditions import split
from simbias.config.hydra_config import set_value
from simbias.config.renamed import RENAMED, new_name
from simbias.core import StudyWarning
from simbias.core.errors import LONGEST_KEY
from simbias.core.messages import LONGEST
from simbias.sweep.grid import expand

COMPONENTS = [(group, option) for group, names in options().items() if group != "preset" for option in names]
PROVIDED = {"task", "nominal", "hardware_from"}  # to constructors, by whoever builds a study

BAD = {  # by override: its key, and what is said of it
    "bias.d=abc": ("bias.d", "must be a valid number"),
    "++nominal.uncertainty.masses=true": ("nominal.uncertainty.masses", "must be a number, got true"),
    "bias.d=-1": ("bias.d", "must be greater than or equal to 0, got -1"),
    "cost.state_weights=[-1]": ("cost.state_weights.0", "must be greater than or equal to 0, got -1"),
    "bias.dd=1": ("bias.dd", "no such key; GaussianProcess takes d, fourier_features, "),
    "evaluation.rollouts=1": ("evaluation.rollouts", "no such key; NominalStart takes none"),
    "method.max_iteration=1": ("method.max_iteration", "no such key; did you mean max_iterations?"),
    "hardware.confirmm=true": ("hardware.confirmm", "no such key; did you mean confirm?"),
    "seed.x=1": ("seed.x", "no such key; --cfg job shows all keys, --help the groups; +seed.x=... sets one"),
    "cartpole": ("cartpole", "expected group=option or group.key=value, such as preset=robust"),
    "task=cartpole": ("samples.limits.body_angle", "refers to task.limits.body_angle, which is missing"),
    "+task.horizion=100": ("task.horizion", "no such key; did you mean horizon?"),
    "+bias.dd=1": ("bias.dd", "no such key; if a preset sets it, ~bias.dd leaves it out"),
    "++bias={dd: 1, ee: 2}": (
        "bias.dd",
        "no such key; if a preset sets them, ~bias.dd ~bias.ee leave them out",
    ),
    "bias.length_scale=[1,2]": ("bias", "length_scale has 2 values; the task has 7"),
    "optimizer=unknown": ("optimizer=unknown", "no such option; optimizer has "),
    "preset=[cartpole,unknown]": ("preset=unknown", "no such option"),
    "nosuch=1": ("nosuch", "no such key"),
    "+nosuch=1": ("nosuch", "no such group"),
    "~bias": ("bias", "missing"),
    "bias.d=[1": (
        "bias.d=[1",
        "cannot be parsed (no viable alternative at input '[1'); put the value in quotes",
    ),
    "+task.goal={x: log(t)}": ("+task.goal=", "put an expression in quotes, as in {x: 'sin(t)'}"),
    "bias=[gp,none]": ("bias", "takes one option; only preset takes several"),
    "identification=[delay,posterior]": ("identification", "identification.motors={NAME: {delay: 0.01}}"),
    "bias=gp,none": ("bias=gp,none", "or run many trials as a sweep (+sweep=NAME)"),
    "seed=range(1,3)": ("seed=range(1,3)", "or run many trials as a sweep (+sweep=NAME)"),
    "seed=???": ("seed", "Missing mandatory value"),
    "seed=${nosuch}": ("seed", "refers to nosuch, which is missing; is this option for another robot?"),
    "bias._target_=simbias.cost.quadratic.Quadratic": ("bias._target_", "is not a bias"),
    "bias._target_=simbias.no.such.Class": ("bias._target_", "cannot import 'simbias.no.such.Class'"),
    "+bias.task=1": ("bias.task", "is provided"),
    "hydra.searchpath=[file:///no/such/folder]": ("", "/no/such/folder"),
    "hardware.feet=three": ("hardware.feet", "must be 'plate', 'separate' or 'fixed', got 'three'"),
    "task.robot.wheel_radius=0": ("task.robot.wheel_radius", "must be greater than or equal to 0.000001"),
    "task.start.mean=[0]": ("task.start.mean", "must have at least 6 items"),
    "task.start.mean={angle: 1}": (
        "task.start.mean",
        "is a list, into which no mapping can be merged; give a",
    ),
    "++task.start.mean={angle: 1}": ("task.start.mean", "is a list, into which no mapping can be merged; g"),
    "task.start.mean.angle=1": ("task.start.mean", "is a list: task.start.mean.0=... sets its first value"),
    "task.limits=[1]": ("task.limits", "is a mapping, into which no list can be merged; give a mapping, or"),
    "cost.state_weights=[1]": ("cost", "state_weights has 1 values; the task has 6"),
    "+samples.limits.size=1": ("samples", "limits: the task has no criterion size"),
    "optimizer.algorithm=GN_NONE": ("optimizer", ""),
    f"seed={'{a: ' * 300}1{'}' * 300}": ("seed=", ""),
    f"task.horizon={10**30}": ("task.horizon", ""),
    "task.start.mean=[1e300,0,0,0,0,0]": ("task.start.mean", ""),
    f"seed={2**64}": ("seed", ""),
    f"bias.d={'9' * 5000}": ("bias.d", ""),
}


@pytest.mark.slow
def test_bad_override() -> None:
    for override, (key, problem) in BAD.items():
        with one_line() as error:
            simbias.load([override, "tracking=none"])
        assert error.value.key.startswith(key), override
        assert problem in error.value.problem, override
        assert len(str(error.value)) < LONGEST + LONGEST_KEY + 3


TOGETHER = {
    ("preset=cartpole", "policy=trajectory"): "^policy: follows a plan, so it needs method=trajectory$",
    ("preset=cartpole", "hardware=pymunk"): "^hardware: PymunkBongoboard works with a task of Bongoboard",
    (
        "preset=cartpole_swingup",
        "+cost.widths.zz=1",
    ): r"zz; available: .*; ~cost\.widths\.NAME leaves",
    ("preset=cartpole_swingup", "task.inputs.force.limit=true"): "must be a number, got true$",
    ("preset=cartpole_swingup", "+task.where={a: zz}"): r"^task: where\.a: 'zz': nothing is called zz",
    ("preset=cartpole_swingup", "+task.outputs={a: {value: zz}}"): r"^task: outputs\.a: 'zz': nothing is",
}


@pytest.mark.slow
def test_what_does_not_go_together_is_refused() -> None:
    for overrides, words in TOGETHER.items():
        with one_line(words):
            simbias.load([*overrides, "tracking=none"]).check()


DOUBTFUL = {
    ("policy.observer=kalman", "hardware.noise.angle_variance=1e-4"): "kalman assumes exact measurements; ",
    (
        "task.success.upright.below=20",
    ): r"^success\.upright always holds: abs\(angle_error\) is at most 3\.14",
    ("method.experiments=5", "budget.experiments=3"): "^budget.experiments=3 allows no success, which needs",
}


@pytest.mark.slow
def test_what_is_probably_a_mistake_is_told() -> None:
    for overrides, words in DOUBTFUL.items():
        with pytest.warns(StudyWarning, match=words):
            simbias.load(["preset=cartpole_swingup", *overrides, "tracking=none"]).check()
    with warnings.catch_warnings(action="error"):  # of inputs only
        simbias.load(["policy=mlp", "policy.observer=kalman", "hardware.noise.torque_variance=0.1"]).check()


def test_two_presets_are_one_override() -> None:
    with one_line(r"^preset: is given twice; 'preset=\[cartpole,robust\]' combines two$"):
        compose(["preset=cartpole", "preset=robust"])
    compose(["preset=cartpole", "preset=cartpole"])


def test_an_axis_may_set_the_last_value_of_a_list() -> None:
    """A key below a value that refers to nothing is refused in one line."""
    config = OmegaConf.create({"list": [1, 2], "other": "${none}"})
    OmegaConf.set_struct(config, True)
    set_value(config, "list.-1", 3)
    assert config.list == [1, 3]
    with pytest.raises(ConfigError, match=r"^other\.part: no such key"):
        set_value(config, "other.part", 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "beside", [[], ["+hardware.noise.angle_variance=0.1"]]
)  # which Hydra sees to, or not
def test_a_whole_mapping_adds_its_keys(beside: list[str]) -> None:
    base = ["preset=cartpole", *beside]
    given = compose([*base, "hardware.noise={force_variance: 0.1}", "hardware.values={swing.friction: 0.01}"])
    config = given.config["hardware"]
    assert config["noise"] == {**({"angle_variance": 0.1} if beside else {}), "force_variance": 0.1}
    assert config["values"] == {"swing.friction": 0.01}
    assert compose([*base, "hardware.noise={force_variance: 0.1}"]).config == (
        compose([*base, "+hardware.noise.force_variance=0.1"]).config
    )
    again = ["hardware.noise={force_variance: 0.1}", "hardware.noise={position_variance: 0.2}"]
    assert compose([*base, *again]).config["hardware"]["noise"] == {
        **config["noise"],
        "position_variance": 0.2,
    }
    for group in "hardware", "engine", "hydra", "seed":
        with one_line(rf"^{group}.nosuch: no such key; (\w+ takes|--cfg job shows)"):
            compose([*base, f"{group}.nosuch={{a: 1}}"])


def test_the_last_override_counts() -> None:
    order = (".torque_variance=0.1", "={torque_variance: 0.2}", ".torque_variance=0.3")
    config = compose([f"hardware.noise{each}" for each in order]).config
    assert config["hardware"]["noise"]["torque_variance"] == 0.3


def test_config_dir_must_exist() -> None:
    for folder in ("/no/such/folder", "[" * 400):  # the second is no name that a file system takes
        with pytest.raises(ConfigError, match="--config-dir: no such folder"):
            compose([], folder)
        assert options(folder) == options()


@pytest.mark.slow
def test_presets_combine() -> None:
    """A robot and a method; what one chooses oneself wins over both."""
    combined = compose(["preset=[cartpole,robust]", "bias=none"])
    choices = [combined.choices[group] for group in ("preset", "hardware", "optimizer", "bias")]
    assert choices == ["cartpole,robust", "cartpole", "hybrid_from_candidates", "none"]
    assert combined.hash == compose(["preset=[robust,cartpole]", "bias=none"]).hash
    default, other = compose(), compose(["preset=[acrobot,paper]"])  # the paper's method is had on any robot
    method = ("identification", "bias", "evaluation", "optimizer", "method")
    assert [other.choices[group] for group in method] == [default.choices[group] for group in method]
    assert other.choices["hardware"] == "acrobot"


@pytest.mark.slow
def test_hardware_that_declares_no_noise_is_taken_for_quiet() -> None:
    """As a person, in presets whose filter or identification asks for the hardware's noise; or a number."""
    filtering = compose(["preset=acrobot_trajectory", "hardware=manual", "~hardware.delay"]).config
    identifying = compose(["preset=ball_in_cup", "hardware=manual"]).config
    number = compose(["preset=[cartpole,robust]", "hardware.noise=0.1"]).config
    assert filtering["policy"]["noise"] == identifying["identification"]["noise"] == {}
    assert (number["hardware"]["noise"], number["evaluation"]["noise"]) == (0.1, {})


@pytest.mark.slow
def test_yaml_keys_are_the_constructors_arguments() -> None:
    """Every value a person may change stands in the YAML, to be seen."""
    for group, option in COMPONENTS:
        config, _ = split(shipped(group, option))
        component = component_class(config, group)
        assert set(config) - {"_target_"} == set(constructor_parameters(component)) - PROVIDED, option


def test_defaults_are_table_1() -> None:
    config = compose([]).config
    table = {
        "bias": {"length_scale": 1.0, "signal_variance": 1.0, "d": 1.0},
        "cost": {"failure_weight": 200, "max_cost": 200, "input_weights": [1e-6]}
        | {"state_weights": [10, 10, 10, 0.1, 0.1, 0.1]},
        "task": {"horizon": 5000, "time_step": 0.001, "input_limit": 100},
        "method": {"max_iterations": 10, "experiments": 2},
        "optimizer": {"max_evaluations": 1000, "relative_tolerance": 1e-6},
        "policy": {"bound": 10},
    }
    assert {group: {key: config[group][key] for key in values} for group, values in table.items()} == table
    assert config["bias"]["noise_variance"] == pytest.approx(2.718281828459045**-4, rel=1e-15)


def test_an_error_comes_back_from_a_worker() -> None:
    error = pickle.loads(pickle.dumps(ConfigError("bias.d", "must be greater than 0")))
    assert isinstance(error, ConfigError)
    assert (error.key, str(error)) == ("bias.d", "bias.d: must be greater than 0")


RENAMES = {"bias.reach": "bias.d", "bias=gaussian": "bias=gp", "old_group": "optimizer"}


@pytest.mark.slow
def test_new_names_exist_and_old_ones_do_not() -> None:
    for old, new in RENAMED.items():
        assert _exists(new_name(old) or ""), new
        assert not _exists(old), old
    assert list(RENAMED) == sorted(RENAMED)


def _exists(name: str) -> bool:
    """Whether there is such an option or key."""
    group, equals, option = name.partition("=")
    if equals:
        return option in options().get(group, [])
    group = name.partition(".")[0]
    names = options().get(group, [])
    found = [compose().config, *({group: shipped(group, each)} for each in names if group != "preset")]
    return any(_has(config, name.split(".")) for config in found)


def _has(config: object, parts: list[str]) -> bool:
    """Whether a config has a key."""
    return not parts or (
        isinstance(config, Mapping) and parts[0] in config and _has(config[parts[0]], parts[1:])
    )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of configs, while there are a few renames more."""
    for old, new in RENAMES.items():
        monkeypatch.setitem(RENAMED, old, new)
    return tmp_path


def test_on_the_command_line(folder: Path) -> None:
    for override, line in {
        "bias.reach=2": "bias.reach: is now bias.d",
        "+bias.reach=2": "bias.reach: is now bias.d",
        "bias=gaussian": "bias=gaussian: is now bias=gp",
        "old_group.seed=3": "old_group.seed: is now optimizer.seed",
    }.items():
        with one_line(f"^{line}$"):
            simbias.load([override, "tracking=none"])


@pytest.mark.slow
def test_in_a_file(folder: Path) -> None:
    head = "# @package _global_\n"
    for group, text, line in (
        ("preset", f"{head}bias: {{reach: 2}}", "bias.reach: is now bias.d"),
        ("preset", f"{head}old_group: {{a: 2}}", "is now optimizer.a"),
        ("preset", f"{head}defaults: [{{override /bias: gaussian}}]", "=gp"),
        ("preset", f"{head}defaults: [{{override /old_group: a}}]", "optimi"),
        ("sweeps", "sweep: {trials: 1, axes: {bias.reach: [1, 2]}}", "is now bias.d"),
        ("sweeps", "sweep: {trials: 1, axes: {bias: [gaussian]}}", "is now bias=gp"),
        ("preset", f"{head}defaults: [/bias: none]", "write 'override /bias: OPTION'"),
        ("preset", f"{head}defaults: [bias: none]", "write 'override /bias: none'"),
        ("preset", f"{head}defaults: [override bias: none]", "write 'override /bias: OPTION'"),
        ("preset", "defaults: [override /bias: none]", "A preset's first line is '# @package _global_'"),
        ("preset", "method: {max_iterations: 3}", "must begin with the line '# @package _global_'"),
        ("preset", f"{head}bias: none", "a file's defaults choose an option: 'override /bias: none'"),
        ("sweeps", "defaults: [override bias: none]", "write 'override /bias: OPTION'"),
    ):
        write(folder, {f"{group}/mine.yaml": text})
        use, chosen = (simbias.load, "preset=mine") if group == "preset" else (expand, "+sweep=mine")
        with one_line(re.escape(line)):
            use([chosen, "tracking=none"], folder)  # type: ignore[operator]
