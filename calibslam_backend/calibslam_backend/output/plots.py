"""Pictures of a run: map and trajectory from above, and how the errors compare with their stated covariance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.output.metrics import NoGroundTruth, Trajectory, alignment, interpolated
from calibslam_backend.output.object_map import ObjectMap
from calibslam_msgs_py.measurements import Array

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.legend_handler import HandlerPatch
from matplotlib.patches import Ellipse, Patch
from matplotlib.transforms import Bbox

MARGIN = 0.5  # [m] around what is shown
REACH = 3.0  # [m] farther from the path, an object is not shown: it must not shrink everything else to a dot
# Where the name of an object stands, the first that is free: beside its centre [points], and how it is aligned.
NAME_PLACES = (
    ((0.0, 4.0), "center", "bottom"),
    ((0.0, -4.0), "center", "top"),
    ((6.0, 0.0), "left", "center"),
    ((-6.0, 0.0), "right", "center"),
)
CONFIDENCE = 2.0  # standard deviations that ellipses and bands show


@matplotlib.rc_context({"text.parse_math": False})  # names are texts, whatever signs they hold
def plot_run(
    path: Path,
    title: str,
    result: ObjectMap,
    odometry: Array,
    truth: Trajectory | None,
    objects: Sequence[Ellipsoid] = (),
) -> None:
    """Trajectories and objects from above, and with ground truth the position error over time.

    Args:
        path: of the PNG.
        title: of the picture.
        result: what was estimated.
        odometry: (N, 4, 4) the same keyframes by odometry alone.
        truth: in any frame; None: not known.
        objects: the true ones in the frame of `truth`, as far as they are known.
    """
    title = title.encode(errors="replace").decode()  # names of files may hold bytes that are no characters
    figure, axes = plt.subplots(
        1, 2 if truth is not None else 1, figsize=(14 if truth is not None else 8, 7), squeeze=False, dpi=110
    )
    top = axes[0, 0]
    estimate = Trajectory(np.array(result.stamps), result.poses)
    if truth is not None:
        try:
            T_map_world = np.asarray(np.linalg.inv(alignment(estimate, truth)))
        except NoGroundTruth:
            truth = None
        else:
            inside = (truth.stamps >= result.stamps[0]) & (truth.stamps <= result.stamps[-1])
            true = (T_map_world @ truth.poses[inside])[:, :3, 3]
            top.plot(true[:, 0], true[:, 1], "-", color="0.2", linewidth=2.5, alpha=0.6, label="ground truth")
            _true_objects(top, T_map_world, objects)
    top.plot(*odometry[:, :2, 3].T, ":", color="tab:orange", linewidth=1.5, label="odometry alone")
    top.plot(*result.poses[:, :2, 3].T, "-", color="tab:blue", linewidth=1.5, label="estimate")
    _objects(top, result)
    top.plot(*result.poses[0, :2, 3], "o", color="tab:green", label="start")
    top.set(xlabel="x forward [m]", ylabel="y left [m]", title=f"{title}: seen from above")
    top.set_aspect("equal", adjustable="box")
    low, high = _limits(result, odometry)
    top.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    # Below: inside it would cover some of the map.
    top.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=4, fontsize=8.5, frameon=False,
        handler_map={Ellipse: HandlerPatch(patch_func=_in_legend)},
    )  # fmt: skip
    top.grid(alpha=0.3)
    if truth is not None:
        _errors(axes[0, 1], estimate, result.covariances, odometry, truth)
    elif axes.shape[1] > 1:
        axes[0, 1].set_axis_off()
    figure.tight_layout(pad=1.5)
    figure.draw_without_rendering()  # from now on places in the picture are known
    _names(top, result)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _objects(axes: Axes, result: ObjectMap) -> None:
    """Outlines; the legend names the first of each kind of ellipse, the others have names that it skips."""
    outline, place = "object", f"{CONFIDENCE:g} sigma of its centre"
    for quadric in result.quadrics:
        R = quadric.T_map_object[:3, :3]
        shadow = _from_above(quadric.T_map_object, quadric.radii)
        centre = quadric.T_map_object[:2, 3]
        axes.add_patch(
            _ellipse(centre, shadow, label=outline, facecolor="tab:purple", alpha=0.25, edgecolor="tab:purple")
        )
        outline = "_"
        if np.isfinite(quadric.covariance).all():
            sigma = (R @ quadric.covariance[3:6, 3:6] @ R.T)[:2, :2] * CONFIDENCE**2
            axes.add_patch(_ellipse(centre, sigma, label=place, fill=False, edgecolor="black", linewidth=0.8))
            place = "_"


def _from_above(T: Array, radii: Array) -> Array:
    """(2, 2) the ellipse that is the outline of an ellipsoid from above: the upper left block of its shape."""
    return np.asarray((T[:2, :3] * radii**2) @ T[:2, :3].T)


def _true_objects(axes: Axes, T_map_world: Array, objects: Sequence[Ellipsoid]) -> None:
    label = "true object"
    for thing in objects:
        T = T_map_world @ thing.T_world_object
        shadow = _from_above(T, thing.radii)
        axes.add_patch(_ellipse(T[:2, 3], shadow, label=label, fill=False, edgecolor="0.4", linewidth=0.7))
        label = "_"


def _limits(result: ObjectMap, odometry: Array) -> tuple[Array, Array]:
    """Corners (2,) of what is shown: both paths, and the objects that are not far away."""
    path = result.poses[:, :2, 3]
    low, high = [odometry[:, :2, 3], path], [odometry[:, :2, 3], path]
    for quadric in result.quadrics:
        centre = quadric.T_map_object[:2, 3]
        if np.linalg.norm(path - centre, axis=1).min() < REACH:
            reach = np.minimum(np.sqrt(np.diag(_from_above(quadric.T_map_object, quadric.radii))), REACH)
            low.append(centre[None] - reach)
            high.append(centre[None] + reach)
    return np.concatenate(low).min(axis=0) - MARGIN, np.concatenate(high).max(axis=0) + MARGIN


def _names(axes: Axes, result: ObjectMap) -> None:
    """Names of the objects where they cover no other, the largest objects first; one that has no place is left out."""
    taken: list[Bbox] = []
    for quadric in sorted(result.quadrics, key=lambda quadric: -float(quadric.radii.max())):
        x, y = quadric.T_map_object[:2, 3]
        for offset, horizontal, vertical in NAME_PLACES:
            name = axes.annotate(
                quadric.class_id, (x, y), offset, textcoords="offset points", fontsize=7, ha=horizontal, va=vertical,
                annotation_clip=True,
            )  # fmt: skip
            box = name.get_window_extent().padded(1.0)
            if not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            name.remove()


def _in_legend(
    orig_handle: Patch, xdescent: float, ydescent: float, width: float, height: float, **_: object
) -> Ellipse:
    """An ellipse as what it is: matplotlib draws a rectangle for every patch."""
    return Ellipse(((width - xdescent) / 2.0, (height - ydescent) / 2.0), width, height)


def _ellipse(centre: Array, shape: Array, **style: object) -> Ellipse:
    """The set (p - centre)^T shape^-1 (p - centre) <= 1."""
    values, vectors = np.linalg.eigh(shape)
    width, height = 2.0 * np.sqrt(np.maximum(values, 0.0))
    return Ellipse(
        tuple(centre),
        width,
        height,
        angle=float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))),
        **style,
    )


def _errors(axes: Axes, estimate: Trajectory, covariances: Array, odometry: Array, truth: Trajectory) -> None:
    covered, true = interpolated(truth, estimate.stamps)
    if np.count_nonzero(covered) < 2:
        axes.set_axis_off()
        return
    seconds = (np.asarray(estimate.stamps) - estimate.stamps[0])[covered] * 1e-9
    true = (estimate.poses[covered][0] @ np.linalg.inv(true[0]) @ true)[:, :3, 3]
    for poses, colour, style, name in (
        (odometry, "tab:orange", ":", "odometry alone"),
        (estimate.poses, "tab:blue", "-", "estimate"),
    ):
        error = np.linalg.norm(poses[covered][:, :3, 3] - true, axis=1)
        axes.plot(seconds, error, style, color=colour, label=f"error, {name}, at most {error.max():.2f} m")
    spread = np.sqrt(np.trace(covariances[covered][:, 3:, 3:], axis1=1, axis2=2))
    axes.fill_between(seconds, 0.0, CONFIDENCE * spread, color="tab:blue", alpha=0.15,
                      label=f"{CONFIDENCE:g} sigma of the estimate, as stated")  # fmt: skip
    # Odometry may drift out of sight: what counts is the estimate and its band.
    reach = 1.3 * max(error.max(), CONFIDENCE * spread.max())
    if reach > 0.0:
        axes.set(ylim=(0.0, reach))
    axes.set(xlabel="time [s]", ylabel="position error [m]")
    axes.set_title("error with the first pose aligned with the truth (ATE aligns the whole path)", fontsize=10)
    axes.legend(loc="upper left", fontsize=9)
    axes.grid(alpha=0.3)
