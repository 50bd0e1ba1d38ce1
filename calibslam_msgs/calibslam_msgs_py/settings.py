"""Settings: one frozen dataclass per component, from which command line, ROS parameters and YAML are derived.

    @dataclass(frozen=True)
    class Noise(Settings):
        sigma: float = setting(5.0, "standard deviation of an edge", unit="px", low=0.1)

A default, its unit and its bounds stand there and nowhere else. A value outside its bounds is refused, never
corrected; so is an infinite one.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

S = TypeVar("S")


class SettingsError(ValueError):
    """A setting that does not exist or has a bad value; the text names it and what is valid."""


def setting(
    default: Any,
    meaning: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """A field of a settings dataclass: bool, int, float or str.

    Args:
        default: its value where none is given.
        meaning: what it is, in a few words.
        unit: e.g. "px"; "" for a pure number.
        low, high: smallest and largest valid value.
        choices: the valid texts, for a text that is not free.
    """
    metadata = {"meaning": meaning, "unit": unit, "low": low, "high": high, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of settings dataclasses: validates on construction."""

    def __post_init__(self) -> None:
        validate(self)


def validate(settings: Any) -> None:
    """Check every setting of an instance.

    Raises:
        SettingsError: naming the first bad value and what is valid.
    """
    kinds = kinds_of(type(settings))
    for field in settings_fields(type(settings)):
        _checked(field, kinds[field.name], getattr(settings, field.name))


def from_mapping(cls: type[S], values: Mapping[str, Any]) -> S:
    """The settings with these values, e.g. from YAML, and defaults for the others.

    Raises:
        SettingsError: an unknown name or a bad value.
    """
    fields = {field.name: field for field in settings_fields(cls)}
    for name in values:
        if name not in fields:
            raise SettingsError(f"unknown setting '{name}'; valid are: {', '.join(fields)}")
    kinds = kinds_of(cls)
    return cls(**{name: _checked(fields[name], kinds[name], value) for name, value in values.items()})


def add_arguments(parser: argparse.ArgumentParser, cls: type) -> None:
    """Options of a command line: `frame_rate` becomes --frame-rate, a bool --x and --no-x."""
    kinds = kinds_of(cls)
    for field in settings_fields(cls):
        kind, choices = kinds[field.name], field.metadata["choices"]
        text = f"{describe(field)} (default: {field.default})".replace("%", "%%")
        option = "--" + field.name.replace("_", "-")
        if kind is bool:
            parser.add_argument(
                option,
                dest=field.name,
                action=argparse.BooleanOptionalAction,
                default=field.default,
                help=text,
            )
        elif choices:
            parser.add_argument(option, dest=field.name, choices=choices, default=field.default, help=text)
        else:
            parser.add_argument(
                option,
                dest=field.name,
                type=_argument_type(field, kind),
                default=field.default,
                metavar=field.metadata["unit"].upper() or kind.__name__.upper(),
                help=text,
            )


def from_arguments(arguments: argparse.Namespace, cls: type[S]) -> S:
    """The settings that a parser with `add_arguments` read."""
    return from_mapping(cls, {field.name: getattr(arguments, field.name) for field in settings_fields(cls)})


def declare_parameters(node: Any, cls: type[S]) -> S:
    """Declare each setting as a read-only ROS parameter and return the values the user gave.

    Raises:
        SettingsError: a bad value.
    """
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
    from rclpy.exceptions import InvalidParameterValueException

    kinds = kinds_of(cls)
    values = {}
    for field in settings_fields(cls):
        low, high = field.metadata["low"], field.metadata["high"]
        descriptor = ParameterDescriptor(
            description=describe(field),
            additional_constraints=" or ".join(field.metadata["choices"]),
            read_only=True,
            # An integer given for a double is meant as one; rclpy refuses it unless types may change.
            dynamic_typing=kinds[field.name] is float,
        )
        if kinds[field.name] is float and (low is not None or high is not None):
            largest = 1.7976931348623157e308
            bounds = FloatingPointRange(
                from_value=float(-largest if low is None else low),
                to_value=float(largest if high is None else high),
            )
            descriptor.floating_point_range = [bounds]
        elif kinds[field.name] is int and (low is not None or high is not None):
            bounds = IntegerRange(
                from_value=int(-(2**63) if low is None else low),
                to_value=int(2**63 - 1 if high is None else high),
                step=1,
            )
            descriptor.integer_range = [bounds]
        given = node._parameter_overrides.get(field.name)
        value = field.default if given is None else _checked(field, kinds[field.name], given.value)
        try:
            node.declare_parameter(field.name, value, descriptor, ignore_override=True)
        except InvalidParameterValueException as error:
            raise SettingsError(str(error)) from error
        values[field.name] = value
    return from_mapping(cls, values)


def describe(field: dataclasses.Field[Any]) -> str:
    """Meaning, unit and bounds in one line."""
    text = str(field.metadata["meaning"])
    if field.metadata["unit"]:
        text += f" [{field.metadata['unit']}]"
    valid = valid_values(field)
    return f"{text}; {valid}" if valid else text


def settings_fields(cls: type) -> list[dataclasses.Field[Any]]:
    """Those of a dataclass that are settings."""
    return [field for field in dataclasses.fields(cls) if "meaning" in field.metadata]


def kinds_of(cls: type) -> dict[str, type]:
    """Name -> bool, int, float or str; annotations may be texts."""
    return typing.get_type_hints(cls)


def valid_values(field: dataclasses.Field[Any]) -> str:
    """What is valid, in words; "" where everything of its type is."""
    low, high, choices = field.metadata["low"], field.metadata["high"], field.metadata["choices"]
    if choices:
        return f"one of {', '.join(choices)}"
    if low is not None and high is not None:
        return f"{low} to {high}"
    if low is not None:
        return f"at least {low}"
    return f"at most {high}" if high is not None else ""


def _checked(field: dataclasses.Field[Any], kind: type, value: Any) -> Any:
    """The value as `kind`; an integer is a valid float, nothing else is converted."""
    expected = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}[kind]
    accepted = (int, float) if kind is float else (kind,)
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise SettingsError(f"{field.name} = {value!r}: must be {expected} ({describe(field)})")
    value = kind(value)
    low, high, choices = field.metadata["low"], field.metadata["high"], field.metadata["choices"]
    outside = (low is not None and value < low) or (high is not None and value > high)
    finite = kind is not float or math.isfinite(value)
    if outside or (choices and value not in choices) or not finite:
        valid = (valid_values(field) or expected) + ("" if finite else " and finite")
        raise SettingsError(f"{field.name} = {value!r}: must be {valid} ({describe(field)})")
    return value


def _argument_type(field: dataclasses.Field[Any], kind: type) -> Callable[[str], Any]:
    def convert(text: str) -> Any:
        try:
            return _checked(field, kind, kind(text))
        except SettingsError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    convert.__name__ = kind.__name__  # argparse names it in "invalid int value"
    return convert
