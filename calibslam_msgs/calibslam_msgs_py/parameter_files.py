"""Parameter files (YAML) and tables (Markdown) of nodes, from the settings that they declare."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from calibslam_msgs_py.settings import describe, kinds_of, settings_fields, valid_values

WIDTH = 116  # of a comment


@dataclass(frozen=True)
class NodeParameters:
    """What can be set of a node.

    Attributes:
        package, executable: as `ros2 run` takes them.
        meaning: first paragraph of its module's docstring.
        settings: classes that it declares, in this order.
    """

    package: str
    executable: str
    meaning: str
    settings: tuple[type, ...]

    @classmethod
    def of_module(cls, package: str, executable: str, module: ModuleType) -> NodeParameters:
        """Of the module of a node: the classes that it gives to `declare_parameters`."""
        names = re.findall(r"declare_parameters\(\s*self,\s*(\w+)", inspect.getsource(module))
        meaning = " ".join((module.__doc__ or "").partition("\n\n")[0].split())
        return cls(package, executable, meaning, tuple(getattr(module, name) for name in names))

    def groups(self) -> Iterator[tuple[str, list[tuple[dataclasses.Field[Any], type]]]]:
        """(title, [(field, its type)]) of the classes that the settings were put together from."""
        for settings in self.settings:
            kinds = kinds_of(settings)
            groups: dict[str, list[tuple[dataclasses.Field[Any], type]]] = {}
            for field in settings_fields(settings):
                owner = next(c for c in reversed(settings.__mro__) if field.name in getattr(c, "__annotations__", {}))
                groups.setdefault(_title(owner), []).append((field, kinds[field.name]))
            yield from groups.items()


def _title(settings: type) -> str:
    """MotionNoise -> motion noise; GraphSettings -> graph."""
    return re.sub(r"(?<!^)(?=[A-Z])", " ", settings.__name__.removesuffix("Settings")).lower()


def yaml_text(node: NodeParameters, command: str) -> str:
    """The parameter file with all defaults, for a node of any name in any namespace.

    Args:
        command: that makes the file.
    """
    path = f"{node.package}/config/{node.executable}.yaml"
    lines = [
        *(f"# {line}" for line in _wrapped(node.meaning)),
        f"# All of its parameters, at their defaults. Made by: {command}",
        f"# Use: ./calibslam run {node.package} {node.executable} --ros-args --params-file {path}",
        "/**:",
        "  ros__parameters:",
        "    # Take the time from /clock, as when a bag is played.",
        "    use_sim_time: false",
    ]
    for title, fields in node.groups():
        lines += ["", f"    # -- {title} --"]
        for field, _ in fields:
            lines += [f"    # {line}" for line in _wrapped(describe(field))]
            lines.append(f"    {field.name}: {_yaml_value(field.default)}")
    return "\n".join(lines) + "\n"


def _wrapped(text: str) -> list[str]:
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > WIDTH - 6:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}".strip()
    return [*lines, line]


def _yaml_value(value: object) -> str:
    """As YAML 1.1 and ROS both read it: a double has a point, a text has quotes."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = repr(value)
        mantissa, exponent, power = text.partition("e")
        return text if "." in mantissa else f"{mantissa}.0{exponent}{power}"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return str(value)


def markdown_text(nodes: Sequence[NodeParameters], command: str) -> str:
    """A page with a table for each node."""
    lines = [
        "# Parameters",
        "",
        f"Made from the code by `{command}`. Each node also has a commented file with all of its defaults,",
        "`PACKAGE/config/NODE.yaml`, installed into `share/PACKAGE/config`. They are given at the start and read-only",
        "from then on; unknown ones and bad values end the node with exit code 2 and a line that says what is valid:",
        "",
        "```bash",
        "./calibslam run calibslam_backend backend --ros-args --params-file calibslam_backend/config/backend.yaml",
        "./calibslam run calibslam_backend backend --ros-args -p noise_model:=fixed -p map_period:=0.5",
        "```",
        "",
        "`slam_bag` takes the same settings as options: `noise_model` becomes `--noise-model`.",
    ]
    for node in nodes:
        lines += ["", f"## {node.package} {node.executable}", "", node.meaning]
        lines += ["", "| parameter | type | default | valid | unit | meaning |", "|---|---|---|---|---|---|"]
        for _, fields in node.groups():
            for field, kind in fields:
                cells = (
                    f"`{field.name}`",
                    {bool: "bool", int: "integer", float: "double", str: "string"}[kind],
                    f"`{_yaml_value(field.default)}`",
                    valid_values(field),
                    str(field.metadata["unit"]),
                    str(field.metadata["meaning"]),
                )
                lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
