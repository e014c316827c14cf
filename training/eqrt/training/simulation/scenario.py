"""SUMO scenarios (`*.sumocfg`): what they are made of, without what they would write.

A scenario's own outputs land beside its files or where they say; a generator must leave neither
traces nor fail where it may not write. So SUMO gets a configuration of ours, in a scratch folder:
the same inputs and options, and detectors that write nowhere.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from eqrt.core.errors import LogError

_FILES = {  # synonym -> the option's name
    "net-file": "net-file",
    "net": "net-file",
    "n": "net-file",
    "route-files": "route-files",
    "routes": "route-files",
    "r": "route-files",
    "additional-files": "additional-files",
    "additional": "additional-files",
    "a": "additional-files",
    "weight-files": "weight-files",
    "weights": "weight-files",
    "w": "weight-files",
    "load-state": "load-state",
}
_DROPPED_SECTIONS = {"output", "report", "gui_only", "random_number"}
_OURS = {  # what eqrt sets itself
    "begin",
    "b",
    "end",
    "e",
    "step-length",
    "seed",
    "random",
    "scale",
    "lateral-resolution",
}
_READ_THEIR_FILE = {"rerouter", "calibrator", "variableSpeedSign"}


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario file, read and found to name its network."""

    name: str
    """The file's, or its folder's where the file is just called `run`, `sumo` or `osm`."""
    net: Path
    options: tuple[tuple[str, str], ...]
    """SUMO's options and their values, files as absolute paths separated by commas."""

    def write_quiet(self, folder: Path) -> Path:
        """A configuration in `folder` that runs the scenario and writes nothing.

        Raises LogError if it cannot be written.
        """
        root = ElementTree.Element("configuration")
        for option, value in self.options:
            files = value.split(",") if option == "additional-files" else []
            quiet = [str(_silenced(Path(file), folder, i)) for i, file in enumerate(files)]
            ElementTree.SubElement(root, option, value=",".join(quiet) or value)
        path = folder / "quiet.sumocfg"
        ElementTree.ElementTree(root).write(path)
        return path


def read_scenario(path: Path) -> Scenario:
    """Raises LogError if `path` is not a SUMO configuration, or a file that it names is missing."""
    options = []
    for option, value in _settings(path):
        kind = _FILES.get(option)
        if kind is not None:
            options.append((kind, ",".join(_existing(path, file) for file in value.split(","))))
        elif option not in _OURS and not option.endswith("-output"):
            options.append((option, value))
    nets = [value for option, value in options if option == "net-file"]
    if len(nets) != 1:
        raise LogError(f"{path}: it names {len(nets)} networks (net-file), expected one")
    plain = path.name.partition(".")[0]
    name = path.resolve().parent.name if plain in {"run", "sumo", "osm"} else plain
    return Scenario(name, Path(nets[0]), tuple(options))


def _settings(path: Path) -> Iterator[tuple[str, str]]:
    """Options and values of a configuration, in sections or not."""
    try:
        root = ElementTree.parse(path).getroot()
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such scenario; give a SUMO configuration (.sumocfg)") from error
    except (OSError, ElementTree.ParseError) as error:
        raise LogError(f"{path}: not a SUMO configuration ({error})") from error
    for element in root:
        if element.tag in _DROPPED_SECTIONS:
            continue
        for setting in (element, *element):
            value = setting.get("value", setting.get("v"))
            if value is not None:
                yield setting.tag, value


def _existing(scenario: Path, file: str) -> str:
    path = scenario.resolve().parent / file.strip()
    if not path.is_file():
        raise LogError(f"{scenario}: it names {file.strip()}, which is not there; copy it again")
    return str(path)


def _silenced(path: Path, folder: Path, number: int) -> Path:
    """`path`, or a copy in `folder` whose detectors write nowhere."""
    try:
        tree = ElementTree.parse(path)
    except (OSError, ElementTree.ParseError):
        return path  # compressed, or wrong: SUMO will read it, or say what is wrong
    writes = False
    for element in tree.iter():
        for attribute in {"file", "output", "dest"}.intersection(element.keys()):
            if attribute == "output" or element.tag not in _READ_THEIR_FILE:
                element.set(attribute, os.devnull)
                writes = True
    if not writes:
        return path
    copy = folder / f"{number}-{path.name}"
    tree.write(copy)
    return copy
