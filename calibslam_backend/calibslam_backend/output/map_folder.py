"""The folder that paths in service calls are confined to: who can call a service must not be able to write anywhere."""

from __future__ import annotations

from pathlib import Path


class PathRefused(ValueError):
    """A path that is not in the folder; the text names both and what to do."""


def confined(path: str, folder: Path) -> Path:
    """The file that a path, absolute or from the folder on, means.

    Raises:
        PathRefused: it is empty, no path, or leads out of the folder (also by a link).
    """
    if not path:
        raise PathRefused("the path is empty")
    try:
        inside, file = folder.resolve(), (folder / path).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise PathRefused(f"{path!r} is no path that can be used: {error}") from None
    if not file.is_relative_to(inside) or file == inside:
        raise PathRefused(
            f"{path} is not a file in {inside}: maps lie there, unless parameter map_folder says otherwise"
        )
    return file
