"""Who may import what: algorithms know no ROS, and packages keep their order."""

import ast
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
PACKAGES = ("calibslam_backend", "calibslam_detector", "calibslam_sim")
# Of these, only the nodes and calibslam_msgs_py know anything.
ROS = {"rclpy", "rosbags", "tf2_ros", "ament_index_python", "builtin_interfaces"}
# Which packages of ours each may import besides itself and calibslam_msgs_py.
ALLOWED: dict[str, set[str]] = {
    "calibslam_backend": set(),
    "calibslam_detector": set(),
    "calibslam_sim": {"calibslam_backend", "calibslam_detector"},
}


def imports(file: Path) -> set[str]:
    """All modules that a file imports, wherever in it; of `from a.b import c` both a.b and a.b.c."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            found.add(node.module or "")
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def is_ros(module: str) -> bool:
    root, *rest = module.split(".")
    return root in ROS or root.endswith(("_msgs", "_interfaces", "_srvs")) or (rest[:1] == ["msg"])


def knows_ros(module: str) -> bool:
    """Whether a module of calibslam_msgs_py pulls rclpy in."""
    return module.startswith("calibslam_msgs_py.node")


MODULES = [file for package in PACKAGES for file in sorted((PROJECT / package / package).rglob("*.py"))]


@pytest.mark.parametrize("file", MODULES, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_imports(file: Path) -> None:
    package = file.relative_to(PROJECT).parts[0]
    modules = imports(file)
    foreign = {m.split(".")[0] for m in modules} & (set(PACKAGES) - ALLOWED[package] - {package})
    assert not foreign, f"{package} must not import {foreign}"
    if not file.name.endswith("_node.py"):
        ros = sorted(m for m in modules if is_ros(m) or knows_ros(m))
        assert not ros, f"only *_node.py may import {ros}"


@pytest.mark.parametrize("file", MODULES, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_no_command_takes_abbreviations(file: Path) -> None:
    assert "argparse.ArgumentParser(" not in file.read_text(), "calibslam_msgs_py.command has one without them"


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_know_each_other_in_one_direction(package: str) -> None:
    root = PROJECT / package / package
    folders = {folder.name for folder in root.iterdir() if (folder / "__init__.py").exists()}
    known = {
        folder: {
            m.split(".")[1]
            for file in (root / folder).rglob("*.py")
            for m in imports(file)
            if m.startswith(f"{package}.")
        }
        & folders - {folder}
        for folder in folders
    }
    assert len(folders) > 3
    left = set(folders)
    while free := {folder for folder in left if not known[folder] & left}:
        left -= free
    assert not left, f"these know each other in a circle: {sorted(left)}"


@pytest.mark.parametrize("module", ["measurements", "covariance", "conversions", "bags", "settings"])
def test_offline_modules_load_no_rclpy(module: str) -> None:
    """Also not on a detour."""
    code = f"import sys, calibslam_msgs_py.{module}; sys.exit('rclpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_executable_can_be_loaded() -> None:
    """What setup.py names exists, as installed."""
    points = [
        point
        for group in ("console_scripts", "calibslam.calibrators", "calibslam.reference_boxes")
        for point in entry_points(group=group)
        if point.value.startswith("calibslam_")
    ]
    assert {point.value.split(".")[0] for point in points} == set(PACKAGES)
    for point in points:
        assert callable(point.load()), point
