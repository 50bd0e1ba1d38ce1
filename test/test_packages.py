"""package.xml names what each package imports: by a rosdep key where there is one, otherwise in its comment."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
MODULES = {
    "calibslam_msgs": "calibslam_msgs_py",
    "calibslam_backend": "calibslam_backend",
    "calibslam_detector": "calibslam_detector",
    "calibslam_sim": "calibslam_sim",
}
# Keys of the public index (rosdep/python.yaml of ros/rosdistro). `rosdep install` fails at a key that it does not know.
KEYS = {
    "cv2": "python3-opencv",
    "joblib": "python3-joblib",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "scipy": "python3-scipy",
    "sklearn": "python3-sklearn",
    "yaml": "python3-yaml",
}
WITHOUT_KEY = {"evo", "gtsam", "plotly", "pycocotools", "rosbags", "threadpoolctl", "torch", "torchvision"}


def imported(package: str) -> set[str]:
    """Names of the modules of others that a package imports."""
    names = set()
    for file in (PROJECT / package / MODULES[package]).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
                names.add(node.module.split(".")[0])
    return names - set(sys.stdlib_module_names) - {"__future__", MODULES[package]}


def declared(package: str) -> tuple[set[str], set[str]]:
    """Keys, and what the comment says to have none."""
    text = (PROJECT / package / "package.xml").read_text()
    keys = set(re.findall(r"<\w*depend>([\w-]+)</\w*depend>", text))
    comment = re.search(r"Without a rosdep key, see requirements.txt: ([\w, ]+)\.", text)
    return keys, set(comment[1].split(", ")) if comment else set()


@pytest.mark.parametrize("package", MODULES)
def test_dependencies(package: str) -> None:
    keys, without = declared(package)
    names = imported(package)
    packages = {package: folder for folder, package in MODULES.items()}
    needed = {KEYS.get(name, packages.get(name, name)) for name in names - WITHOUT_KEY}
    assert needed <= keys, f"{package}/package.xml lacks {sorted(needed - keys)}"
    assert without == names & WITHOUT_KEY
    python = {key for key in keys if key.startswith("python3-")}
    assert python <= set(KEYS.values()), "keys that may not exist"
    requirements = (PROJECT / "requirements.txt").read_text()
    assert all(re.search(rf"^{name}==", requirements, re.MULTILINE) for name in without)
