"""`parameters`: writes the parameter files of all nodes and docs/parameters.md, from their settings."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path

from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.parameter_files import NodeParameters, markdown_text, yaml_text

COMMAND = "./calibslam run calibslam_sim parameters"


def nodes() -> list[NodeParameters]:
    """All nodes of the installed packages that have settings."""
    found = []
    for point in entry_points(group="console_scripts"):
        package = point.module.partition(".")[0]
        if package.startswith("calibslam_") and point.module.endswith("_node"):
            node = NodeParameters.of_module(package, point.name, importlib.import_module(point.module))
            if node.settings:
                found.append(node)
    return sorted(set(found), key=lambda node: (node.package, node.executable))


def files() -> dict[Path, str]:
    """Text of each file by its path in the project."""
    every = nodes()
    result = {Path(node.package, "config", f"{node.executable}.yaml"): yaml_text(node, COMMAND) for node in every}
    result[Path("docs/parameters.md")] = markdown_text(every, COMMAND)
    return result


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of the executable; returns the exit code."""
    parser = ArgumentParser(prog="parameters", description=__doc__)
    parser.add_argument("--project", type=Path, default=Path(), metavar="DIR", help="the source tree (default: .)")
    project: Path = parser.parse_args(arguments).project
    if not (project / "calibslam_backend" / "package.xml").exists():
        print(
            f"error: {project.absolute()} is not the source tree of CalibSLAM; name it: --project DIR", file=sys.stderr
        )
        return 1
    for path, text in files().items():
        target = project / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
