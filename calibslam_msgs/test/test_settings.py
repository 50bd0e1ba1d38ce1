"""One definition of a setting serves the constructor, YAML, the command line and ROS parameters."""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import rclpy
from rclpy.node import Node

from calibslam_msgs_py.node import refuse_unknown_parameters
from calibslam_msgs_py.settings import (
    Settings,
    SettingsError,
    add_arguments,
    declare_parameters,
    from_arguments,
    from_mapping,
    setting,
)


@dataclass(frozen=True)
class Example(Settings):
    sigma: float = setting(5.0, "standard deviation of an edge", unit="px", low=0.1)
    share: float = setting(0.05, "share of outliers, below 100 %", low=0.0, high=1.0)
    offset: float = setting(0.0, "added to each edge", unit="px")
    skip: int = setting(10, "updates between relinearisations", low=1)
    robust: bool = setting(True, "whether the loss is robust")
    model: str = setting("calibrated", "noise model", choices=("calibrated", "fixed"))
    frame: str = setting("map", "name of the map's frame")


BAD = [
    ("sigma", 0.0, "sigma = 0.0: must be at least 0.1"),
    ("sigma", float("nan"), "sigma = nan"),
    ("sigma", float("inf"), "sigma = inf: must be at least 0.1 and finite"),
    ("offset", -float("inf"), "offset = -inf: must be a number and finite"),
    ("sigma", "5", "must be a number"),
    ("sigma", True, "must be a number"),
    ("share", 1.5, "must be 0.0 to 1.0"),
    ("skip", 2.0, "must be an integer"),
    ("skip", 0, "at least 1"),
    ("robust", 1, "true or false"),
    ("model", "best", "one of calibrated, fixed"),
    ("frame", 3, "must be a text"),
]


@pytest.mark.parametrize(("name", "value", "text"), BAD)
def test_bad_values_are_refused(name: str, value: object, text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        from_mapping(Example, {name: value})
    with pytest.raises(SettingsError, match=text):
        Example(**{name: value})  # type: ignore[arg-type]


def test_unknown_names_are_refused_with_the_valid_ones() -> None:
    with pytest.raises(SettingsError, match="unknown setting 'sgima'; valid are: sigma, share"):
        from_mapping(Example, {"sgima": 1.0})


def test_defaults_and_conversion() -> None:
    assert from_mapping(Example, {}) == Example()
    settings = from_mapping(Example, {"sigma": 3})
    assert settings.sigma == 3.0 and isinstance(settings.sigma, float)


def parsed(*arguments: str) -> Example:
    parser = argparse.ArgumentParser()
    add_arguments(parser, Example)
    return from_arguments(parser.parse_args(arguments), Example)


def test_command_line() -> None:
    assert parsed() == Example()
    assert parsed("--sigma", "3", "--no-robust", "--model", "fixed", "--skip", "2") == Example(
        sigma=3.0, robust=False, model="fixed", skip=2
    )


def test_bad_command_lines_say_why(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, text in (
        (("--sigma", "0"), "sigma = 0.0: must be at least 0.1 (standard deviation of an edge [px]"),
        (("--sigma", "inf"), "sigma = inf: must be at least 0.1 and finite"),
        (("--sigma", "wide"), "invalid float value: 'wide'"),
        (("--skip", "1.5"), "invalid int value"),
        (("--model", "best"), "invalid choice: 'best'"),
    ):
        with pytest.raises(SystemExit):
            parsed(*arguments)
        assert text in capsys.readouterr().err


def test_help_gives_meaning_unit_and_default() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser, Example)
    text = " ".join(parser.format_help().split())
    assert "standard deviation of an edge [px]; at least 0.1 (default: 5.0)" in text
    assert "share of outliers, below 100 %; 0.0 to 1.0 (default: 0.05)" in text


@pytest.fixture
def context() -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def node_with(context: rclpy.Context, *parameters: str) -> Node:
    arguments = ["--ros-args"]
    for parameter in parameters:
        arguments += ["-p", parameter]
    return Node("example", context=context, cli_args=arguments, use_global_arguments=False)


def test_ros_parameters(context: rclpy.Context) -> None:
    node = node_with(context, "sigma:=3", "robust:=false", "model:=fixed", "use_sim_time:=true")
    settings = declare_parameters(node, Example)
    assert settings == Example(sigma=3.0, robust=False, model="fixed")
    assert node.get_parameter("sigma").value == 3.0
    descriptor = node.describe_parameter("share")
    assert descriptor.read_only and "share of outliers" in descriptor.description
    assert descriptor.floating_point_range[0].to_value == 1.0
    assert not node.set_parameters([rclpy.parameter.Parameter("sigma", value=1.0)])[0].successful
    refuse_unknown_parameters(node)


@pytest.mark.parametrize(
    "parameter", ["sigma:=0.0", "offset:=.inf", "skip:=1.5", "robust:=1", "model:=best", "frame:=3"]
)
def test_bad_ros_parameters_are_refused(context: rclpy.Context, parameter: str) -> None:
    with pytest.raises(SettingsError, match=parameter.split(":")[0]):
        declare_parameters(node_with(context, parameter), Example)


def test_unknown_ros_parameters_are_refused(context: rclpy.Context) -> None:
    node = node_with(context, "sgima:=3.0")
    declare_parameters(node, Example)
    with pytest.raises(SettingsError, match="unknown parameter sgima; valid are: frame, model"):
        refuse_unknown_parameters(node)
