"""The picture of a run: drawn whatever its objects and its recording are called, and what it has room for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.text import Annotation

from calibslam_backend.output import plots
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.output.plots import plot_run
from calibslam_msgs_py.measurements import QuadricEstimate

# Formulas, as matplotlib would read them, that are none; characters without a glyph.
NAMES = ("x$^$", "cash_{$\\frac$", "Tasse ☕ 茶碗", "\0\x1b[0m\t\n", "")


def a_map(*quadrics: QuadricEstimate) -> ObjectMap:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :2, 3] = [[0.0, 0.0], [1.0, 0.3], [2.0, 0.0]]
    return ObjectMap((0, 1, 2), poses, np.tile(np.eye(6), (3, 1, 1)), quadrics)


def quadric(number: int, x: float, y: float, radius: float = 0.2, class_id: str = "keyboard") -> QuadricEstimate:
    T = np.eye(4)
    T[:2, 3] = x, y
    return QuadricEstimate(number, class_id, T, np.full(3, radius), np.eye(9) * 1e-4, 3)


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize(
    ("name", "title"), [*((name, "desk") for name in NAMES), *(("cup", name) for name in (*NAMES, "\udcff"))]
)
def test_any_name_is_drawn(name: str, title: str, tmp_path: Path) -> None:
    known = a_map(quadric(0, 0.0, 0.0, 0.1, name))
    plot_run(tmp_path / "run.png", title, known, known.poses, None)
    assert (tmp_path / "run.png").stat().st_size > 5000


def test_objects_at_the_edge_are_shown_and_far_ones_are_not() -> None:
    known = a_map(quadric(0, 1.0, 2.5), quadric(1, 1.0, -40.0))
    low, high = plots._limits(known, known.poses)
    np.testing.assert_allclose(low, [-plots.MARGIN, -plots.MARGIN])
    np.testing.assert_allclose(high, [2.0 + plots.MARGIN, 2.7 + plots.MARGIN])


def test_names_cover_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten objects at nearly the same place: there is room for some names, and the largest object has one."""
    known = a_map(*(quadric(k, 1.0 + 0.001 * k, 1.0, 0.1 + 0.01 * k) for k in range(10)))
    monkeypatch.setattr(plt, "close", lambda figure: None)
    plot_run(tmp_path / "run.png", "run", known, known.poses, None)
    monkeypatch.undo()
    (axes,) = plt.gcf().axes
    names = [text for text in axes.texts if isinstance(text, Annotation)]
    boxes = [name.get_window_extent() for name in names]
    assert 2 <= len(boxes) < 10
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    assert names[0].xy == pytest.approx((1.009, 1.0))
    plt.close()
