"""Bad input ends in one line that names the key, before anything runs."""

from __future__ import annotations

import pickle
from typing import get_type_hints

import pytest
from conftest import OWN_CONF, POINT_MASS, rest_slow, slow_case
from shipped import file_of, overrides, shipped

import simbias
from simbias.config import ConfigError, compose, options
from simbias.config.components import TARGET, component_class, constructor_parameters
from simbias.config.conditions import split
from simbias.trial.study import Study

COMPONENTS = [(group, option) for group, names in options().items() if group != "preset" for option in names]
OF_STUDIES = [(group, option) for group, option in COMPONENTS if group not in ("engine", "tracking")]


@pytest.mark.parametrize(
    ("override", "message"),
    rest_slow(
        14,
        [
            ("bias.d=abc", "bias.d: must be a valid number"),
            ("bias.d=true", "bias.d: must be a number, got true"),
            ("seed=false", "seed: must be a number, got false"),
            ("++nominal.uncertainty.masses=true", "nominal.uncertainty.masses: must be a number, got true"),
            ("bias.d=-1", "bias.d: must be greater than 0, got -1"),
            ("bias.dd=1", "bias.dd: no such key"),
            ("+bias.dd=1", "bias.dd: no such key"),
            ("bias.length_scale=[1,2]", "bias: length_scale has 2 values; the task has 7"),
            ("optimizer=unknown", "optimizer=unknown: no such option; optimizer has "),
            ("nosuch=1", "nosuch: no such key"),
            ("~bias", "bias: missing"),
            ("bias.d=[1", "bias.d=[1: cannot be parsed (no viable alternative at input '[1'); quotes keep"),
            ("bias=[gp,none]", "bias"),
            ("seed=???", "seed: Missing mandatory value"),
            ("bias._target_=simbias.cost.quadratic.Quadratic", "bias._target_: "),
            ("+bias.task=1", "bias.task: is provided"),
            ("hydra.searchpath=[file:///no/such/folder]", "/no/such/folder"),
            ("bias.d=nan", "bias.d: must be a finite number"),
            ("+nosuch=1", "nosuch: no such group"),
            ("bias", "missing EQUAL"),
            (
                "bias.d=a=b",
                "bias.d=a=b: cannot be parsed (mismatched input '=' expecting <EOF>); quotes keep",
            ),
            ("bias.d='a", "bias.d='a: cannot be parsed; quotes keep"),
            ("bias.d=1,2", "bias.d=1,2"),
            ("seed=-1", "seed: must be greater than or equal to 0, got -1"),
            ("seed=1.5", "seed: must be a valid integer"),
            ("seed=${nosuch}", "seed: Interpolation key 'nosuch' not found"),
            (
                "hardware.inertia_error=-2",
                "hardware.inertia_error: must be greater than or equal to -0.99",
            ),
            ("hardware.noise.torque_variance=-1", "hardware.noise.torque_variance: must be greater"),
            ("hardware.feet=three", "hardware.feet: must be 'plate', 'separate' or 'fixed', got 'three'"),
            ("task.horizon=0", "task.horizon: must be greater than 0"),
            (
                "task.robot.wheel_radius=0",
                "task.robot.wheel_radius: must be greater than or equal to 0.000001",
            ),
            ("task.start.mean=[0]", "task.start.mean: must have at least 6 items"),
            ("cost.state_weights=[1]", "cost: state_weights has 1 values; the task has 6"),
            ("+samples.limits.size=1", "samples: limits names no criterion of the task: size"),
            ("bias._target_=simbias.no.such.Class", "bias._target_: cannot import 'simbias.no.such.Class'"),
            ("optimizer.algorithm=GN_NONE", "optimizer"),
        ],
    ),
)
def test_bad_override(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        simbias.load([override, "tracking=none"])
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_config_dir_must_exist() -> None:
    with pytest.raises(ConfigError, match="--config-dir: no such folder"):
        compose([], "/no/such/folder")


@pytest.mark.slow
@pytest.mark.parametrize(("group", "option"), OF_STUDIES)
def test_every_shipped_option_builds(group: str, option: str) -> None:
    study = simbias.load(["tracking=none", *overrides(group, option)])
    assert isinstance(getattr(study, group), get_type_hints(Study)[group])


@pytest.mark.parametrize("option", options()["preset"])
def test_every_preset_builds(option: str) -> None:
    study = simbias.load(["tracking=none", f"preset={option}"])
    assert study.choices["preset"] == option


def test_presets_combine() -> None:
    """A robot and a method; what one chooses oneself wins over both."""
    combined = compose(["preset=[cartpole,robust]", "bias=none"])
    choices = [combined.choices[group] for group in ("preset", "hardware", "optimizer", "bias")]
    assert choices == ["cartpole,robust", "cartpole", "hybrid_from_candidates", "none"]
    assert combined.hash == compose(["preset=[robust,cartpole]", "bias=none"]).hash


def test_the_papers_method_is_had_on_any_robot() -> None:
    default, other = compose(), compose(["preset=[acrobot,paper]"])
    method = ("identification", "bias", "evaluation", "optimizer", "method")
    assert [other.choices[group] for group in method] == [default.choices[group] for group in method]
    assert other.choices["hardware"] == "acrobot"


@pytest.mark.parametrize(
    ("group", "option"),
    [case if TARGET in file_of(*case) else slow_case(case) for case in COMPONENTS],  # composing takes longer
)
def test_yaml_keys_are_the_constructors_arguments(group: str, option: str) -> None:
    """Every value a person may change stands in the YAML, to be seen."""
    config, _ = split(shipped(group, option))
    component = component_class(config, group)
    assert set(config) - {"_target_"} == set(constructor_parameters(component)) - {"task"}


def test_own_components_come_from_a_config_dir() -> None:
    study = simbias.load([*POINT_MASS, "tracking=none"], OWN_CONF)
    assert type(study.nominal).__module__ == "point_mass"
    searched = simbias.load([*POINT_MASS, "tracking=none", f"hydra.searchpath=[file://{OWN_CONF}]"])
    assert searched.hash == study.hash


@pytest.mark.slow
def test_hash_follows_what_affects_the_result() -> None:
    base = compose([]).hash
    assert compose(["tracking=none"]).hash == base
    assert compose(["seed=1"]).hash != base
    assert compose(["bias.d=2"]).hash != base
    assert compose(["bias=gp", "seed=0"]).hash == base


def test_defaults_are_table_1() -> None:
    config = compose([]).config
    assert config["bias"]["length_scale"] == 1.0
    assert config["bias"]["signal_variance"] == 1.0
    assert config["bias"]["noise_variance"] == pytest.approx(2.718281828459045**-4, rel=1e-15)
    assert config["bias"]["d"] == 1.0
    assert config["cost"]["failure_weight"] == config["cost"]["max_cost"] == 200
    assert config["cost"]["input_weights"] == [1e-6]
    assert config["cost"]["state_weights"] == [10, 10, 10, 0.1, 0.1, 0.1]
    assert config["task"]["horizon"] == 5000
    assert config["task"]["time_step"] == 0.001
    assert config["task"]["input_limit"] == 100
    assert (config["method"]["max_iterations"], config["method"]["experiments"]) == (10, 2)
    assert config["optimizer"]["max_evaluations"] == 1000
    assert config["optimizer"]["relative_tolerance"] == 1e-6
    assert config["policy"]["bound"] == 10


def test_an_error_comes_back_from_a_worker() -> None:
    error = pickle.loads(pickle.dumps(ConfigError("bias.d", "must be greater than 0")))
    assert isinstance(error, ConfigError)
    assert (error.key, str(error)) == ("bias.d", "bias.d: must be greater than 0")
