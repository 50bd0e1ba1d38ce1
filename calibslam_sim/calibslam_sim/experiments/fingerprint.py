"""Which state of the code, and which files, made a result: repetitions of two states do not belong into one table."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("calibslam_msgs_py", "calibslam_backend", "calibslam_detector", "calibslam_sim")
DIGITS = 12  # of the hash that are kept


def fingerprint() -> str:
    """Version of this package and hash of all Python sources of ours, e.g. "0.1.0+3f2a90c1d4e5"."""
    folders = [(name, Path(next(iter(import_module(name).__path__)))) for name in PACKAGES]
    return f"{version('calibslam_sim')}+{sources_hash(folders)}"


def sources_hash(folders: Iterable[tuple[str, Path]]) -> str:
    """Hash of names and contents of all Python files in named folders, wherever these lie."""
    digest = hashlib.sha256()
    for name, folder in folders:
        for path in sorted(folder.rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{name}/{path.relative_to(folder).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()[:DIGITS]


def file_hashes(files: Mapping[str, Path]) -> dict[str, str]:
    """Hash of the content of each of some named files."""
    return {name: hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS] for name, path in files.items()}
