"""Files that cannot be read break nothing that does not ask for them, and are one line where it does."""

import os
from collections.abc import Callable
from pathlib import Path

import hydra
import pytest
from errors import one_line
from omegaconf import OmegaConf
from texts import write

import simbias
from simbias.config import ConfigError, compose, option_files, sweeps
from simbias.config.hydra_config import WITHOUT_JOBS, overridden
from simbias.config.resources import resource_folder
from simbias.core.errors import LONGEST_KEY
from simbias.core.messages import LONGEST
from simbias.sweep.grid import expand

LONGEST_LINE = LONGEST + LONGEST_KEY + 3
ALIASES = "".join(f"b{i}: &b{i} [{','.join(9 * [f'*b{i - 1}'])}]\n" for i in range(1, 12))
BROKEN: dict[str, Callable[[Path], object]] = {
    "folder": Path.mkdir,
    "dangling": lambda path: path.symlink_to("nowhere"),
    "cut": lambda path: path.write_text("a: [1"),
    "bytes": lambda path: path.write_bytes(b"a: \xff\xfe"),
    "number": lambda path: path.write_text("3"),
    "names": lambda path: path.write_text("[1, 2]"),
    "code": lambda path: path.write_text("a: !!python/object/apply:os.getcwd []"),
    "cycle": lambda path: path.write_text("defaults: [cycle]\nsweep: {trials: 1, axes: {}}"),
    "unknown": lambda path: path.write_text(f"defaults: [{'x' * 300}]"),
}


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    """A folder of configs, among them a good one in each group."""
    good = {"bias": "_target_: simbias.learning.bias.none.NoBias", "sweeps": "sweep: {trials: 1, axes: {}}"}
    for group, text in good.items():
        write(tmp_path, {f"{group}/good.yaml": text})
        for name, make in BROKEN.items():
            make(tmp_path / group / f"{name}.yaml")
    return tmp_path


@pytest.mark.slow
def test_nobody_asks_for_them(conf: Path) -> None:
    assert len(expand(["+sweep=good", "bias=good", "tracking=none"], conf).trials) == 1
    assert {"good", "cut", "table2"} <= set(sweeps(conf))


@pytest.mark.slow
def test_somebody_asks_for_one(conf: Path) -> None:
    for use, group in ((simbias.load, "bias"), (expand, "+sweep")):
        for name in BROKEN:
            with one_line() as error:
                use([f"{group}={name}", "tracking=none"], conf)  # type: ignore[operator]
            text = str(error.value)
            assert len(text) < LONGEST_LINE
            assert name in text or text.startswith("bias: must be a mapping")


@pytest.mark.slow
def test_what_is_no_name_or_a_long_one_is_a_short_line() -> None:
    for form in ("bias={}", "+sweep={}", "{}=1", "+{}=1", "bias=../{}", "bias.d={}", "bias.d=[{}"):
        with pytest.raises(ConfigError) as error:
            simbias.load([form.format(5000 * "x"), "tracking=none"])
        assert len(str(error.value)) < LONGEST_LINE
    for override in ("bias=[1]", "bias=[null]", "bias=3", "bias={a: 1}"):
        with one_line():
            simbias.load([override, "tracking=none"])
    with pytest.raises(ConfigError, match=r"^seed=9+ \.\.\. 9+: Exceeds the limit \(4300 digits\)"):
        overridden([f"seed={'9' * 5000}"])


@pytest.mark.slow
def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    for name in ("a,b=c d", "a'b\\c[d}ü"):
        write(tmp_path, {f"{name}/bias/mine.yaml": "_target_: simbias.learning.bias.none.NoBias"})
        assert compose(["bias=mine"], tmp_path / name).hash == compose(["bias=none"]).hash


@pytest.mark.slow
def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    """Compositions are kept; what they were read from may be edited meanwhile, as beside a notebook."""
    texts = {"bias": "_target_: simbias.learning.bias.gp.GaussianProcess\nd: {}", "sweeps": "a: {}"}
    for group, text in texts.items():
        for value in (1, 22):
            write(tmp_path, {f"{group}/mine.yaml": text.format(value)})
            config = compose(["bias=mine"] if group == "bias" else ["+sweep=mine"], tmp_path).config
            assert (config["bias"]["d"] if group == "bias" else config["a"]) == value


@pytest.mark.slow
def test_a_file_whose_aliases_never_end_is_named(tmp_path: Path) -> None:
    for group, use in (("bias", "bias=mine"), ("sweeps", "+sweep=mine")):
        write(tmp_path, {f"{group}/mine.yaml": f"b0: &b0 [1]\n{ALIASES}"})
        with pytest.raises(ConfigError, match=rf"{group}/mine\.yaml: its aliases expand to 8e\+10 values"):
            compose([use], tmp_path)
        (tmp_path / group / "mine.yaml").write_text("b0: &b0 [1]\nb1: [*b0, *b0]")
        assert compose([use], tmp_path)
    (tmp_path / "components.yaml").write_text(f"b0: &b0 [{','.join(9 * '1')}]\n{ALIASES}")
    with pytest.raises(ConfigError, match=r"components\.yaml"):
        compose([], tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes")
def test_a_pipe_in_place_of_a_config_is_named_where_it_is_asked_for(tmp_path: Path) -> None:
    for group, use in (("bias", "bias=mine"), ("sweeps", "+sweep=mine")):
        (tmp_path / group).mkdir()
        os.mkfifo(tmp_path / group / "mine.yaml")
        with pytest.raises(ConfigError, match=r"mine(\.yaml: is not a regular file|: no such option)"):
            compose([use], tmp_path)
    assert compose(["+sweep=smoke"], tmp_path)


@pytest.mark.slow
def test_compositions_are_hydras() -> None:
    """Although options are read once, and values are merged without it."""
    option_files.register()
    for overrides in (
        ["preset=[pendulum_swingup,scratch]"],
        ["bias=mean", "+hardware.noise.a=1"],
        ["bias.d=0.3", "seed=2", "bias.d=0.4"],
        ["hardware.noise={torque_variance: 0.1}", "task.horizon=7"],
        ["seed=${optimizer.max_evaluations}", "optimizer.algorithm='a b'"],
    ):
        with hydra.initialize_config_dir(str(resource_folder("conf").resolve()), version_base="1.3"):
            by_hydra = hydra.compose("config", [*WITHOUT_JOBS, *overrides])
        assert compose(overrides).config == OmegaConf.to_container(by_hydra, resolve=True)
