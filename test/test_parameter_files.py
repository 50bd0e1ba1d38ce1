"""The parameter files and docs/parameters.md are those that the settings in the code make."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml

from calibslam_backend.backend_node import NodeSettings
from calibslam_backend.estimator import EstimatorSettings
from calibslam_msgs_py.settings import from_mapping, settings_fields
from calibslam_sim import parameters

PROJECT = Path(__file__).resolve().parents[1]


def test_files_are_current(tmp_path: Path) -> None:
    for path, text in parameters.files().items():
        there = (PROJECT / path).read_text() if (PROJECT / path).exists() else ""
        assert there == text, f"{path} is not what the code makes; run: {parameters.COMMAND}"


def test_no_file_is_left_of_a_node_that_is_gone() -> None:
    there = {path.relative_to(PROJECT) for path in PROJECT.glob("calibslam_*/config/*.yaml")}
    assert there == set(parameters.files()) - {Path("docs/parameters.md")}


def test_a_file_holds_the_defaults_in_the_right_types() -> None:
    """Of the node with most settings; what YAML says is what the dataclasses take, and nothing is missing."""
    text = (PROJECT / "calibslam_backend/config/backend.yaml").read_text()
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert values.pop("use_sim_time") is False
    known: set[str] = set()
    for settings in (NodeSettings, EstimatorSettings):
        names = {field.name for field in settings_fields(settings)}
        assert from_mapping(settings, {name: values[name] for name in names}) == settings()
        known |= names
    assert values.keys() == known


def test_every_setting_is_explained() -> None:
    """One comment at least above each, with the unit where there is one."""
    for node in parameters.nodes():
        lines = (PROJECT / node.package / "config" / f"{node.executable}.yaml").read_text().splitlines()
        for _, fields in node.groups():
            for field, _ in fields:
                k = next(i for i, line in enumerate(lines) if line.startswith(f"    {field.name}:"))
                assert lines[k - 1].startswith("    # "), field.name


@pytest.mark.parametrize("executable", ["backend", "detection2d", "record"])
def test_a_node_says_what_it_is(executable: str, capsys: pytest.CaptureFixture[str]) -> None:
    """And starts nothing; the file that it names is there."""
    (point,) = (p for p in entry_points(group="console_scripts") if p.name == executable and "calibslam" in p.module)
    main = point.load()
    for flag in ("-h", "--help"):
        assert main([flag, "--ros-args", "-p", "no:=parameter"]) == 0
        said = capsys.readouterr().out
        assert f"Node `{executable}`: " in said and " -> " in said
        files = re.findall(r"calibslam_\w+/config/\w+\.yaml", said)
        assert all((PROJECT / file).exists() for file in files)
        assert len(files) == (executable != "detection2d")
        assert ("no parameters" in said) == (executable == "detection2d")


def test_elsewhere_it_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert parameters.main(["--project", str(tmp_path)]) == 1
    assert "is not the source tree" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_it_writes_what_it_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "calibslam_backend").mkdir()
    (tmp_path / "calibslam_backend" / "package.xml").touch()
    assert parameters.main(["--project", str(tmp_path)]) == 0
    named = capsys.readouterr().out.split()
    assert {Path(name) for name in named} == set(parameters.files())
    assert all((tmp_path / name).read_text() for name in named)
