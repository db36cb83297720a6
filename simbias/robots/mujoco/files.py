"""Reading MJCF and URDF files with MuJoCo, and writing MJCF."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from math import prod
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from simbias.core.files import sought
from simbias.core.messages import quote, words
from simbias.robots.mujoco.parameters import mujoco

# Limits that keep the reading of a file within seconds.
MOST_COPIES = 10_000  # of an element, by replicate, composite and flexcomp
MOST_CELLS = 10**8  # of a height field or a texture

FOLDERS = ("meshdir", "texturedir", "assetdir")  # attributes that name folders,
NAMING = (
    "file",
    "filename",
    *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")),
)  # files


def read_model(file: str, actuators: Sequence[str] = ()) -> Any:
    """The compiled model of a file.

    The file is MJCF or URDF, relative to the folder where simbias is started; or `package:path` for a file
    installed with a package. An unnamed actuator gets the name of its joint or site; an unnamed joint gets
    that of its body. For a name among `actuators` of a joint but no actuator, a motor is added there.

    ValueError, in one line with the file's name, if it cannot be read.
    """
    path = _path(file)
    if not path.is_file():
        raise ValueError(f"no such file: {path}{sought(str(path))}")
    try:
        return _spec(path, actuators).compile()
    except Exception as error:  # MuJoCo's, of many types
        text = words(error)
        hint = " (motion needs no geometry: visual and collision may be removed)" * ("package:/" in text)
        raise ValueError(f"{file}: {text}{hint}") from error


def source_files(file: str) -> list[Path]:
    """A file and all files it refers to: includes, attached models, meshes, textures, height fields."""
    found: list[Path] = []
    homes, folders, names = {_path(file).parent}, {""}, {_path(file).name}
    strips = False
    while new := [
        path
        for path in {home / folder / name for home in homes for folder in folders for name in names}
        if path not in found and path.is_file()
    ]:
        for path in new:
            with suppress(ElementTree.ParseError):  # not XML
                for element in ElementTree.parse(path).iter():
                    folders |= {element.attrib[name] for name in FOLDERS if name in element.attrib}
                    names |= {element.attrib[name] for name in NAMING if name in element.attrib}
                    strips |= element.get("strippath") == "true"
                homes.add(path.parent)
        names |= {Path(name).name for name in names if strips}
        found += new
    return sorted(found)


def mjcf(file: str, actuators: Sequence[str], model: Any) -> str:
    """The MJCF of a compiled model that was read from a file and then changed; numbers have six digits.

    Inertias are written out; paths of meshes and textures are absolute.
    """
    engine, path = mujoco(), _path(file)
    spec = _spec(path, actuators)
    spec.compile()
    spec.compiler.inertiafromgeom = engine.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for body in spec.bodies[1:]:
        i, body.explicitinertial, body.fullinertia = body.id, True, [np.nan] * 6
        body.mass, body.inertia = model.body_mass[i], model.body_inertia[i]
        body.ipos, body.iquat = model.body_ipos[i], model.body_iquat[i]
    spec.compile()
    spec.copy_back(model)
    spec.stat.meaninertia = np.nan  # set by copying; it has no effect, and is not allowed in a file
    for folder in ("meshdir", "texturedir"):
        own = path.parent / (getattr(spec.compiler, folder) or "")
        setattr(spec.compiler, folder, str(own.resolve()))
    return str(spec.to_xml())


def _spec(path: Path, actuators: Sequence[str]) -> Any:
    """The specification of a file, with unnamed elements named, and motors at joints named as actuators."""
    engine = mujoco()
    _check_size(path)
    spec = engine.MjSpec.from_file(str(path))
    _name(spec.joints, "joint", [joint.parent.name for joint in spec.joints])
    _name(spec.actuators, "actuator", [actuator.target for actuator in spec.actuators])
    known = {actuator.name for actuator in spec.actuators}
    for name in actuators:
        if name not in known and any(joint.name == name for joint in spec.joints):
            spec.add_actuator(name=name, target=name, trntype=engine.mjtTrn.mjTRN_JOINT)
    return spec


def _path(file: str) -> Path:
    """The path of a file, which may be given as `package:path`."""
    package, colon, inside = file.partition(":")
    if not colon or not package.isidentifier():
        return Path(file).expanduser()
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"{file}: the package {package} is not installed: pip install {package}")
    return Path(spec.submodule_search_locations[0]) / inside


def _name(elements: Sequence[Any], kind: str, names: Sequence[str]) -> None:
    """Name unnamed elements: by the given name, or by their kind and a number if it is taken."""
    known = {element.name for element in elements}
    for index, (element, name) in enumerate(zip(elements, names, strict=True)):
        if not element.name:
            element.name = name if name and name not in known else f"{kind}_{index}"
            known.add(element.name)


def _check_size(path: Path, copies: int = 1, within: tuple[Path, ...] = ()) -> None:
    """Refuse a file that MuJoCo would read for hours, or that would fill the memory.

    The file occurs `copies` times within the files that include it, up to the whole model's file.
    """
    if path in within:
        raise ValueError(f"{path.name} includes itself")
    _check_element(_root(path), (*within, path), copies)


def _check_element(element: Any, within: tuple[Path, ...], copies: int) -> None:
    """Refuse an element that makes too many things, in `copies` copies of itself."""
    if element.tag in ("hfield", "texture"):
        _limit(element, _product(element, "nrow", "ncol", "width", "height"), MOST_CELLS, "cells")
    if element.tag in ("replicate", "composite", "flexcomp"):
        copies *= _product(element, "count")
        _limit(element, copies, MOST_COPIES, "copies")
    if element.tag == "include" and "file" in element.attrib:
        _check_size(within[-1].parent / element.attrib["file"], copies, within)
    if element.tag == "attach":
        for file in _attached(element.get("model"), within) - set(within):  # a model may attach itself
            _check_size(file, copies, within)
    for child in element:
        _check_element(child, within, copies)


def _attached(name: str | None, within: tuple[Path, ...]) -> set[Path]:
    """The files of the models with this name, as declared in files that include each other."""
    homes = {*within, *source_files(str(within[-1]))}
    named = [(home, each) for home in homes for each in _root(home).iter("model") if "file" in each.attrib]
    models = [(home.parent / each.attrib["file"], each) for home, each in named]
    return {path for path, each in models if name in (each.get("name"), _root(path).get("model"))}


def _root(path: Path) -> Any:
    """The root of an XML file; an empty element if it is not XML, since MuJoCo's message is better."""
    with suppress(ElementTree.ParseError, OSError):
        return ElementTree.parse(path).getroot()
    return ElementTree.Element("")


def _product(element: Any, *attributes: str) -> int:
    """The product of the integers in an element's attributes; anything else counts as 1."""
    listed = [number for name in attributes for number in element.get(name, "").split()]
    return prod(int(number) for number in listed if number.isdecimal())


def _limit(element: Any, number: int, most: int, things: str) -> None:
    """Refuse an element that makes too many things."""
    if number > most:
        name = f" {quote(element.attrib['name'])}" if "name" in element.attrib else ""
        raise ValueError(f"{element.tag}{name} makes {number:.3g} {things}, more than {most:.0e}")
