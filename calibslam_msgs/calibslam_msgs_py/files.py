"""Files that are whole or not there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def partial_of(path: Path) -> Path:
    """Where that which is to be at a path is written until it is whole: beside it, `.NAME.part`."""
    return path.with_name(f".{path.name}.part")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """The path to write to, see `partial_of`, which becomes the file in one step; its folders are made.

    Where writing fails or is interrupted, an earlier file stays as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_of(path)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file in one step, see `whole`."""
    with whole(path) as partial:
        partial.write_bytes(data)
