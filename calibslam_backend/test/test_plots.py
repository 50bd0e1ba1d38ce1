"""The picture of a run is drawn whatever its objects and its recording are called."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.output.plots import plot_run
from calibslam_msgs_py.measurements import QuadricEstimate

# Formulas, as matplotlib would read them, that are none; characters without a glyph.
NAMES = ("x$^$", "cash_{$\\frac$", "Tasse ☕ 茶碗", "\0\x1b[0m\t\n", "")


def a_map(class_id: str) -> ObjectMap:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :2, 3] = [[0.0, 0.0], [1.0, 0.3], [2.0, 0.0]]
    quadric = QuadricEstimate(0, class_id, np.eye(4), np.full(3, 0.1), np.eye(9) * 1e-4, 3)
    return ObjectMap((0, 1, 2), poses, np.tile(np.eye(6), (3, 1, 1)), (quadric,))


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize(
    ("name", "title"), [*((name, "desk") for name in NAMES), *(("cup", name) for name in (*NAMES, "\udcff"))]
)
def test_any_name_is_drawn(name: str, title: str, tmp_path: Path) -> None:
    known = a_map(name)
    plot_run(tmp_path / "run.png", title, known, known.poses, None)
    assert (tmp_path / "run.png").stat().st_size > 5000
