"""Files that cannot be read break nothing that does not ask for them, and are one line where it does."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

import simbias
from simbias.config import ConfigError, compose, resources
from simbias.core.errors import LONGEST_KEY
from simbias.core.messages import LONGEST
from simbias.sweep.grid import expand

pytestmark = pytest.mark.slow

BOMB = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [{','.join(9 * [f'*a{i - 1}'])}]\n" for i in range(1, 9))
DEEP = "a: " + 1000 * "[" + 1000 * "]"
BROKEN: dict[str, Callable[[Path], object]] = {
    "folder": Path.mkdir,
    "dangling": lambda path: path.symlink_to("nowhere"),
    "circle": lambda path: path.symlink_to(path.name),
    "pipe": os.mkfifo,
    "cut": lambda path: path.write_text("a: [1"),
    "bytes": lambda path: path.write_bytes(b"a: \xff\xfe"),
    "number": lambda path: path.write_text("3"),
    "names": lambda path: path.write_text("[1, 2]"),
    "deep": lambda path: path.write_text(DEEP),
    "bomb": lambda path: path.write_text(BOMB),
    "code": lambda path: path.write_text("a: !!python/object/apply:os.getcwd []"),
    "cycle": lambda path: path.write_text("defaults: [cycle]\nsweep: {trials: 1, axes: {}}"),
    "unknown": lambda path: path.write_text(f"defaults: [{'x' * 300}]"),
}


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    """A folder of configs, among them a good one in each group."""
    good = {"bias": "_target_: simbias.learning.bias.none.NoBias", "sweeps": "sweep: {trials: 1, axes: {}}"}
    for group, text in good.items():
        (tmp_path / group).mkdir()
        for name, make in BROKEN.items():
            make(tmp_path / group / f"{name}.yaml")
        (tmp_path / group / "good.yaml").write_text(text)
        for name in (b"\xff\xfe.yaml", b"a\nb.yaml"):
            Path(os.fsdecode(os.fsencode(tmp_path / group) + b"/" + name)).write_text(text)
    return tmp_path


def test_nobody_asks_for_them(conf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(expand(["+sweep=good", "bias=good", "tracking=none"], conf).trials) == 1
    monkeypatch.setattr(resources, "resource_folder", lambda folder: conf / folder)
    assert all(name.isprintable() for name in resources.sweeps())
    assert {"good", "cut"} <= set(resources.sweeps())
    assert not {"folder", "dangling", "circle", "pipe"} & set(resources.sweeps())


@pytest.mark.parametrize("name", BROKEN)
@pytest.mark.parametrize("group", ["bias", "+sweep"])
def test_somebody_asks_for_one(conf: Path, group: str, name: str) -> None:
    use: Callable = expand if group == "+sweep" else simbias.load
    with pytest.raises(ConfigError) as error:
        use([f"{group}={name}", "tracking=none"], conf)
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < LONGEST + LONGEST_KEY + 3
    assert name in text or text.startswith("bias: must be a mapping")


@pytest.mark.parametrize("length", [300, 5000])
@pytest.mark.parametrize(
    "form", ["bias={}", "+sweep={}", "{}=1", "+{}=1", "bias=../{}", "bias.d={}", "bias.d=[{}"]
)
def test_a_long_name_is_a_short_line(form: str, length: int) -> None:
    with pytest.raises(ConfigError) as error:
        simbias.load([form.format(length * "x"), "tracking=none"])
    assert len(str(error.value)) < LONGEST + LONGEST_KEY + 3


@pytest.mark.parametrize("name", ["a,b", "a=b", "a b", "a'b", "a\\b", "a[b}", "ü"])
def test_a_folder_may_have_any_name(tmp_path: Path, name: str) -> None:
    (tmp_path / name / "bias").mkdir(parents=True)
    (tmp_path / name / "bias" / "mine.yaml").write_text("_target_: simbias.learning.bias.none.NoBias")
    assert compose(["bias=mine"], tmp_path / name).hash == compose(["bias=none"]).hash


@pytest.mark.parametrize(
    "override", ["bias=[inf]", "bias=[1]", "bias=[null]", "bias=3", "+sweep=[inf]", "bias={a: 1}"]
)
def test_an_option_is_a_name(override: str) -> None:
    with pytest.raises(ConfigError) as error:
        simbias.load([override, "tracking=none"])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("override", ["bias=\udce9", "tracking.journals='a\udce9'", "\udce9"])
def test_bytes_that_are_no_text_are_refused(override: str) -> None:
    """A store could not keep them."""
    with pytest.raises(ConfigError, match=r"\\udce9.*: is no UTF-8$"):
        compose([override, "tracking=none"])


def test_components_that_nobody_can_read_are_named(tmp_path: Path) -> None:
    for text in (BOMB, "a: [1", "3"):
        (tmp_path / "components.yaml").write_text(text)
        with pytest.raises(ConfigError, match=r"components\.yaml"):
            compose([], tmp_path)


def test_an_error_that_cannot_speak_is_one_line() -> None:
    from simbias.core.messages import quote, words

    class Mute(Exception):  # noqa: N818
        def __str__(self) -> str:
            raise RuntimeError

    assert words(Mute()) == "(its message cannot be read)"
    assert words(ValueError()) == "ValueError"
    assert quote(10**5000) == "a value of type int"
