"""./calibslam: what it says when something is wrong. It never gets as far as setting anything up here."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
# What the script itself needs, for a PATH that has nothing else.
TOOLS = ["bash", "cat", "cut", "dirname", "env", "flock", "grep", "head", "mkdir", "readlink", "rm", "sed"]
TOOLS += ["sha256sum", "tail"]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The project without anything built, in a folder with a space."""
    folder = tmp_path / "my robot"
    folder.mkdir()
    shutil.copy(PROJECT / "calibslam", folder)
    shutil.copy(PROJECT / "requirements.txt", folder)
    for package in ("calibslam_msgs", "calibslam_backend", "calibslam_detector", "calibslam_sim"):
        shutil.copytree(PROJECT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture
def bare_path(tmp_path: Path) -> Path:
    """A folder for PATH, with the basic tools alone."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        real = shutil.which(tool)
        assert real is not None, tool
        (folder / tool).symlink_to(real)
    return folder


def calibslam(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run it from another folder; a copy of the project in an environment of its own."""
    inherited = dict(os.environ)
    if folder != PROJECT:
        inherited = {name: os.environ[name] for name in ("PATH", "HOME") if name in os.environ}
    return subprocess.run(
        [str(folder / "calibslam"), *arguments],
        env=inherited | environment,
        capture_output=True,
        text=True,
        timeout=120,
        cwd="/",
        stdin=subprocess.DEVNULL,
    )


def script(path: Path, text: str) -> None:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


def test_help_needs_nothing(copy: Path, bare_path: Path) -> None:
    for arguments in ((), ("help",), ("--help",)):
        result = calibslam(copy, *arguments, PATH=str(bare_path))
        assert result.returncode == 0
        assert "demo" in result.stdout and "run PKG EXE" in result.stdout
    assert not (copy / ".venv").exists()


def test_unknown_command(copy: Path) -> None:
    result = calibslam(copy, "dmeo")
    assert result.returncode == 2
    assert "unknown command 'dmeo'" in result.stderr and "usage" in result.stderr
    assert result.stdout == ""


def test_no_python_at_all(copy: Path, bare_path: Path) -> None:
    result = calibslam(copy, "demo", PATH=str(bare_path))
    assert result.returncode == 1
    assert "needs Python 3.11 or 3.12; found: none" in result.stderr
    assert "apt-get install -y python3 python3-dev python3-venv" in result.stderr


def test_unsupported_python_is_named(copy: Path, bare_path: Path) -> None:
    script(bare_path / "python3", "echo 3.13")
    result = calibslam(copy, "demo", PATH=str(bare_path))
    assert result.returncode == 1
    assert "found: python3 is 3.13" in result.stderr
    assert "CALIBSLAM_PYTHON=" in result.stderr


def test_chosen_python_is_the_only_one_tried(copy: Path, bare_path: Path) -> None:
    script(bare_path / "my-python", "echo 3.10")
    result = calibslam(copy, "demo", CALIBSLAM_PYTHON=str(bare_path / "my-python"))
    assert result.returncode == 1
    assert "my-python is 3.10" in result.stderr


def test_everything_missing_is_said_at_once(copy: Path, bare_path: Path) -> None:
    """A Python without headers and venv, and no compiler."""
    script(
        bare_path / "python3",
        'case "$2" in *version_info*) echo 3.12;; *executable*) echo python3;; *include*) echo /nowhere;;'
        " *) exit 1;; esac",
    )
    result = calibslam(copy, "demo", PATH=str(bare_path))
    assert result.returncode == 1
    for text in ("a C++ compiler and make", "/nowhere/Python.h", "the venv module of Python 3.12"):
        assert text in result.stderr
    assert "apt-get install -y build-essential python3.12-dev python3.12-venv" in result.stderr
    assert not (copy / ".venv").exists()


def test_failing_step_shows_the_end_of_its_log(copy: Path, bare_path: Path) -> None:
    """No network: pip says so, and we say what to check."""
    script(
        bare_path / "python3",
        'case "$2" in *version_info*) echo 3.12;; *executable*) echo python3;; *include*) echo "${0%/*}";;'
        ' venv) echo "Temporary failure in name resolution"; exit 1;; esac',
    )
    (bare_path / "Python.h").touch()
    for tool in ("c++", "cc", "make"):
        script(bare_path / tool, "")
    result = calibslam(copy, "demo", PATH=str(bare_path))
    assert result.returncode == 1
    assert "[1/4] creating .venv" in result.stderr
    assert "| Temporary failure in name resolution" in result.stderr
    assert f"the whole log: {copy}/.build/venv.log" in result.stderr
    assert "curl -I https://pypi.org/simple/" in result.stderr


def test_unknown_executable_lists_those_there_are() -> None:
    for arguments in (("calibslam_sim", "smiulate"), ("calibslam_smi", "simulate")):
        result = calibslam(PROJECT, "run", *arguments)
        assert result.returncode == 2
        assert f"no executable '{arguments[1]}' in a package '{arguments[0]}'" in result.stderr
        assert "  calibslam_sim simulate\n" in result.stderr
    result = calibslam(PROJECT, "run")
    assert result.returncode == 2
    assert "  calibslam_backend slam_bag\n" in result.stderr


def test_shell_has_everything_on_the_path() -> None:
    result = calibslam(PROJECT, "shell", "-c", 'python -c "import rclpy, calibslam_msgs.msg" && echo $ROS_DISTRO')
    assert (result.returncode, result.stdout) == (0, "jazzy\n"), result.stderr
