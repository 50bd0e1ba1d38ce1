"""Launch files: every node, file and argument that they name exists. `ros2 launch` itself is not among the wheels."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

PROJECT = Path(__file__).resolve().parents[1]
FILES = sorted(PROJECT.glob("calibslam_*/launch/*.launch.xml"))
# Elements and attributes of ROS 2's XML launch files that are used here.
KNOWN = {
    "launch": set(),
    "arg": {"name", "default", "description"},
    "group": set(),
    "push-ros-namespace": {"namespace"},
    "node": {"pkg", "exec", "output"},
    "param": {"from"},
}


def test_there_are_some() -> None:
    assert len(FILES) >= 2
    for file in FILES:
        assert 'sorted(glob("launch/*.xml"))' in (file.parents[1] / "setup.py").read_text(), "not installed"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_what_is_named_exists(file: Path) -> None:
    root = ElementTree.parse(file).getroot()
    arguments = {argument.get("name"): argument.get("default", "") for argument in root.iter("arg")}
    for element in root.iter():
        assert element.attrib.keys() <= KNOWN[element.tag]
        for value in element.attrib.values():
            assert set(re.findall(r"\$\((?!find-pkg-share |var )", value)) == set()
            assert set(re.findall(r"\$\(var (\w+)\)", value)) <= arguments.keys()
    nodes = list(root.iter("node"))
    for node in nodes:
        package, name = node.attrib["pkg"], node.attrib["exec"]
        assert re.search(rf'f"{name} = {{PACKAGE}}\.\w+:main"', (PROJECT / package / "setup.py").read_text())
        # Each node takes the parameter file of its own name.
        assert [parameter.get("from") for parameter in node] == [f"$(var {name})"]
        assert arguments[name] == f"$(find-pkg-share {package})/config/{name}.yaml"
        assert (PROJECT / package / "config" / f"{name}.yaml").is_file()
    assert len(nodes) == 3 and arguments.keys() == {"namespace", *(node.attrib["exec"] for node in nodes)}
    assert f"ros2 launch {file.parents[1].name} {file.name}" in file.read_text()
