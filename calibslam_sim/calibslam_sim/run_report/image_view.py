"""Images with boxes, their covariances and the quadrics of the map (as the document's Figs. 5.2 and 5.3), as SVG."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape

import cv2
import numpy as np

from calibslam_detector.images.image_conversion import decode_image, encode_jpeg
from calibslam_detector.images.overlay import ellipse_axes
from calibslam_msgs_py.bags import BagReader
from calibslam_msgs_py.conversions import stamp_from_msg
from calibslam_msgs_py.measurements import Array, Boxes, Camera, InvalidMeasurement
from calibslam_sim import topics
from calibslam_sim.run_report.loading import Recorded, Run
from calibslam_sim.run_report.sightings import Sightings
from calibslam_sim.run_report.style import SIGMAS

IMAGES = 4  # that are shown of a run
QUALITY = 80  # of their JPEG


def views(run: Run, seen: Sightings) -> list[str]:
    """SVG of a few keyframes' images, spread over the run; of a grey field where the recording has no images."""
    recorded = run.recorded
    if recorded is None or not len(seen.image):
        return []
    counts = np.bincount(seen.image, minlength=len(recorded.boxes))
    parts = np.array_split(np.arange(len(recorded.boxes)), IMAGES)
    chosen = sorted({int(part[np.argmax(counts[part])]) for part in parts if len(part) and counts[part].max()})
    pictures = _pictures(recorded, {recorded.boxes[k].stamp for k in chosen})
    return [_view(run, recorded, seen, k, pictures.get(recorded.boxes[k].stamp)) for k in chosen]


def _pictures(recorded: Recorded, stamps: set[int]) -> dict[int, np.ndarray]:
    """Images (H, W, 3) RGB of these times, undistorted, where the recording has them."""
    found: dict[int, np.ndarray] = {}
    with BagReader(recorded.path) as bag:
        named = [topic for topic in (topics.IMAGE, topics.RAW_IMAGE) if topic in bag.topics][:1]
        for _, _, message in bag.messages(named):
            stamp = stamp_from_msg(message.header.stamp)
            if stamp not in stamps:
                continue
            try:
                image = decode_image(message)
            except InvalidMeasurement:
                continue  # the view is then drawn without it
            found[stamp] = cv2.undistort(image, recorded.camera.K, recorded.camera.distortion)
            if len(found) == len(stamps):
                break
    return found


def _view(run: Run, recorded: Recorded, seen: Sightings, image: int, picture: np.ndarray | None) -> str:
    boxes, camera = recorded.boxes[image], recorded.camera
    pose = run.map.poses[run.keyframe(boxes.stamp)]
    heuristic = seen.heuristic()
    parts = [_background(camera, picture)]
    for row in np.flatnonzero(seen.image == image):
        quadric = run.map.quadrics[int(seen.quadric[row])]
        outline = projected_outline(pose, quadric.T_map_object, quadric.radii, camera.K)
        if outline is not None:
            parts.append(_ellipse(*outline, 1.0, "quadric"))
        parts += _box(seen.corners[row], seen.covariances[row], float(heuristic[row]))
        parts.append(_name(boxes, int(seen.box[row]), seen.corners[row]))
    seconds = run.seconds[run.keyframe(boxes.stamp)]
    return (
        f'<figure><svg viewBox="0 0 {camera.width} {camera.height}" role="img" '
        f'aria-label="boxes of the image at {seconds:.1f} s">{"".join(parts)}</svg>'
        f"<figcaption>{seconds:.1f} s</figcaption></figure>"
    )


def projected_outline(T_map_camera: Array, T_map_object: Array, radii: Array, K: Array) -> tuple[Array, Array] | None:
    """Centre (2,) and shape (2, 2) [px] of the ellipse that an ellipsoid projects to (eq. 2.3.4); None if it is not
    wholly in front of the camera.
    """
    T = np.linalg.inv(T_map_camera) @ T_map_object
    A, m = K @ T[:3, :3], K @ T[:3, 3]
    C = (A * radii**2) @ A.T - np.outer(m, m)
    if T[2, 3] <= 0.0 or C[2, 2] >= 0.0:
        return None
    centre = C[:2, 2] / C[2, 2]
    return centre, np.outer(centre, centre) - C[:2, :2] / C[2, 2]


def _background(camera: Camera, picture: np.ndarray | None) -> str:
    size = f'width="{camera.width}" height="{camera.height}"'
    if picture is None:
        return f'<rect {size} fill="#777"/>'
    data = base64.b64encode(encode_jpeg(np.ascontiguousarray(picture[..., ::-1]), QUALITY)).decode()
    return f'<image {size} href="data:image/jpeg;base64,{data}"/>'


def _box(corners: Array, covariance: Array, heuristic: float) -> Iterable[str]:
    """The box (4,), and ellipses about its top left and bottom right corners."""
    x, y, right, bottom = corners
    place = f'x="{x:.1f}" y="{y:.1f}" width="{right - x:.1f}" height="{bottom - y:.1f}"'
    yield f'<rect class="rim" {place}/><rect class="box" {place}/>'
    for pair in ((0, 1), (2, 3)):
        yield _ellipse(corners[list(pair)], heuristic**2 * np.eye(2), SIGMAS, "heuristic")
        if not np.isnan(covariance[0, 0]):
            yield _ellipse(corners[list(pair)], covariance[np.ix_(pair, pair)], SIGMAS, "own")


def _ellipse(centre: Array, shape: Array, scale: float, kind: str) -> str:
    """The set (p - centre)^T shape^-1 (p - centre) <= scale^2."""
    axes, angle = ellipse_axes(shape)
    width, height = axes * scale / SIGMAS
    place = (
        f'cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" rx="{width:.1f}" ry="{height:.1f}" '
        f'transform="rotate({np.degrees(angle):.1f} {centre[0]:.1f} {centre[1]:.1f})"'
    )
    return f'<ellipse class="rim" {place}/><ellipse class="{kind}" {place}/>'


def _name(boxes: Boxes, number: int, corners: Array) -> str:
    x, y = np.maximum(corners[:2], [2.0, 14.0])
    return f'<text class="name" x="{x + 3.0:.0f}" y="{y - 4.0:.0f}">{escape(boxes.class_ids[number])}</text>'
