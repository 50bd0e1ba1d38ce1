"""Every command of the README and of docs/ names executables, options, parameters and files that exist."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shlex
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import pytest
import yaml

from calibslam_sim import demo as demo_command
from calibslam_sim import parameters

PROJECT = Path(__file__).resolve().parents[1]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]
COMMANDS = {"demo", "test", "run", "shell", "help"}
NODES = {node.executable: node for node in parameters.nodes()}
EXECUTABLES: dict[tuple[str, str], EntryPoint] = {
    (point.module.partition(".")[0], point.name): point
    for point in entry_points(group="console_scripts")
    if point.module.startswith("calibslam_")
}
COMMAND = re.compile(r"(?:^|`|\s)(\./calibslam (?:demo|test|run|shell)\b[^`\n|]*)")
OF_THE_MIDDLEWARE = "sequence size exceeds remaining buffer"
OF_ROS = {"use_sim_time"}


def commands() -> Iterator[tuple[Path, str]]:
    """(page, command line): of code blocks, of text in backticks and of tables."""
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for line in text.splitlines():
            for match in COMMAND.finditer(line):
                yield page, match.group(1).split("  #")[0].split(" > ")[0].strip()


ALL = sorted({(page.name, line) for page, line in commands()})


@cache
def help_of(package: str, name: str, part: str = "") -> str:
    """What it says of its options, or of those of a part of it, as of an experiment; "" for a node."""
    point = EXECUTABLES[package, name]
    if name in NODES:
        return ""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.raises(SystemExit) as ended:
        importlib.import_module(point.module).main([*part.split(), "--help"])
    assert ended.value.code == 0
    return said.getvalue()


def test_there_are_commands() -> None:
    assert len(ALL) > 30


@pytest.mark.parametrize(("page", "line"), ALL)
def test_a_command_exists(page: str, line: str) -> None:
    words = shlex.split(line.replace("[", " ").replace("]", " "), comments=True)
    assert words[1] in COMMANDS
    if words[1] == "demo":
        check_options(("calibslam_sim", "demo"), words[2:])
    elif words[1] == "test":
        assert all((PROJECT / word).exists() for word in words[2:] if word.startswith("test")), line
    elif words[1] == "run" and len(words) > 3:
        executable = words[2], words[3]
        assert executable in EXECUTABLES, f"there is no {executable[0]} {executable[1]}"
        check_options(executable, words[4:])


def check_options(executable: tuple[str, str], words: list[str]) -> None:
    """Options of a program, parameters and remappings of a node; files of the project exist."""
    at_ros = words.index("--ros-args") if "--ros-args" in words else len(words)
    part = words[0] if executable[1] == "experiment" and not words[0].isupper() else ""
    for word in words[:at_ros]:
        option = word.partition("=")[0]
        if re.fullmatch(r"--[a-z][a-z-]*", option):
            assert re.search(rf"{option}(?![a-z-])", help_of(*executable, part)), (
                f"{executable[1]} has no option {option}"
            )
    for flag, value in zip(words[at_ros:], words[at_ros + 1 :], strict=False):
        if flag == "--params-file":
            assert (PROJECT / value).exists(), value
        elif flag == "-p":
            known = {field.name for _, fields in NODES[executable[1]].groups() for field, _ in fields} | OF_ROS
            assert value.partition(":=")[0] in known, f"{executable[1]} has no parameter {value}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target
    for target in re.findall(r"`((?:docs|docker|test)/[\w/.*-]+)`", page.read_text()):
        assert list(PROJECT.glob(target)), target


def test_what_the_demo_writes_in_a_container_stays() -> None:
    demo = yaml.safe_load((PROJECT / "docker" / "compose.yaml").read_text())["services"]["demo"]
    default = re.search(r'"--out", type=Path, default=Path\("(\w+)"\)', Path(str(demo_command.__file__)).read_text())
    workdir = re.search(r"^WORKDIR (\S+)$", (PROJECT / "docker" / "Dockerfile").read_text(), re.MULTILINE)
    assert default is not None and workdir is not None
    assert demo["volumes"] == [f"../{default[1]}:{workdir[1]}/{default[1]}"]


def test_every_reason_is_explained() -> None:
    """Each name by which the code refuses something stands in the troubleshooting page."""
    page = (PROJECT / "docs" / "troubleshooting.md").read_text()
    source = "".join(
        file.read_text() for package in PROJECT.glob("calibslam_*/calibslam_*") for file in package.rglob("*.py")
    )
    reasons = set(re.findall(r'InvalidMeasurement\(\s*"([a-z_]+)"', source))
    reasons |= set(re.findall(r'"rejected_([a-z_]+)"', source))
    assert len(reasons) > 15
    assert not {reason for reason in reasons if f"`{reason}`" not in page and f"`rejected_{reason}`" not in page}


def test_what_troubleshooting_quotes_is_said() -> None:
    """The beginning of each quoted message, up to the first part that varies, is in the code."""
    source = (PROJECT / "calibslam").read_text() + "".join(
        file.read_text() for package in PROJECT.glob("calibslam_*/calibslam_*") for file in package.rglob("*.py")
    )
    # Texts that are continued on another line of code.
    source = re.sub(r'"\s*\n\s*f?"', "", source)
    page = (PROJECT / "docs" / "troubleshooting.md").read_text()
    quoted = re.findall(r"^\| `([^`]{12,})` \|", page, re.MULTILINE)
    assert len(quoted) > 12
    for text in quoted:
        parts = [part.strip(" '") for part in re.split(r"\.\.\.|[A-Z]{3,}\b", text) if len(part.strip(" '")) > 8]
        for part in parts:
            assert part.removeprefix("rejected_") in source or part == OF_THE_MIDDLEWARE, part
