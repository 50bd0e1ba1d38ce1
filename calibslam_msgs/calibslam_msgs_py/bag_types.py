"""The message definitions that bags are written with: those of ROS 2 Jazzy and of calibslam_msgs."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calibslam_msgs_py.measurements import Array

PACKAGE = "calibslam_msgs"


class BagError(Exception):
    """A bag that cannot be read or written; the text names the next step."""


def definitions_folder() -> Path:
    """Where the .msg files are: in the share folder of the installed package, else in the source tree."""
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    candidates = [prefix / "share" / PACKAGE / "msg" for prefix in prefixes]
    candidates.append(Path(__file__).resolve().parents[1] / "msg")
    for folder in candidates:
        if any(folder.glob("*.msg")):
            return folder
    raise BagError(
        f"the message definitions of {PACKAGE} are not installed; start through ./calibslam, "
        "or build the workspace (colcon build) and source install/setup.bash"
    )


def new_typestore() -> Typestore:
    """ROS 2 Jazzy and calibslam_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    definitions: dict[str, Any] = {}
    for file in sorted(definitions_folder().glob("*.msg")):
        definitions.update(get_types_from_msg(file.read_text(), f"{PACKAGE}/msg/{file.stem}"))
    store.register(definitions)
    return store


@cache
def calibslam_typestore() -> Typestore:
    """The one that all share; nothing is registered in it."""
    return new_typestore()


class BagTypes:
    """The message classes of bags, see `message_types.MessageTypes`; every field has to be given."""

    def __call__(self, name: str) -> Any:
        try:
            return calibslam_typestore().types[name]
        except KeyError:
            raise BagError(f"unknown message type {name}") from None

    def doubles(self, values: Array) -> Array:
        return np.ascontiguousarray(values, dtype=np.float64)

    def octets(self, data: bytes) -> np.ndarray:
        return np.frombuffer(data, dtype=np.uint8)
