"""What Hydra composes of options that are read once is what it composes by itself."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import hydra
import pytest
from omegaconf import OmegaConf

from simbias.config import hydra_config, option_files, resources
from simbias.config.composition import compose
from simbias.config.hydra_config import WITHOUT_JOBS


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    return Path(shutil.copytree(resources.resource_folder("conf"), tmp_path / "conf"))


def by_hydra(folder: Path, overrides: list[str]) -> Any:
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        return OmegaConf.to_container(hydra.compose("config", [*WITHOUT_JOBS, *overrides]), resolve=True)


def test_compositions_are_hydras(conf: Path) -> None:
    option_files.register()
    for overrides in ([], ["preset=[pendulum_swingup,scratch]"], ["bias=mean", "+hardware.noise.a=1"]):
        assert compose(overrides).config == by_hydra(conf, overrides)


def test_a_file_that_changes_is_read_again(conf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (hydra_config, option_files):
        monkeypatch.setattr(module, "resource_folder", lambda _: conf)
    file = conf / "optimizer" / "cma.yaml"
    assert compose(["optimizer=cma"]).config["optimizer"]["population"] == 16
    file.write_text(file.read_text().replace("population: 16", "population: 18"))
    os.utime(file, ns=(1, 1))
    hydra_config.composed.cache_clear()
    assert compose(["optimizer=cma"]).config["optimizer"]["population"] == 18
    hydra_config.composed.cache_clear()
