"""Images of a simulated desk, and the exact boxes of what they show.

What a detector finds hard is there to be seen: motion blur, defocus, noise, darkness, things in front of others,
and the image border.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibslam_backend.geometry.visible_box import image_bounds, project
from calibslam_msgs_py.measurements import SECOND, Array, Camera
from calibslam_sim.rendering.kernels import cast, cast_shadows, shade, visible_parts
from calibslam_sim.rendering.looks import looks
from calibslam_sim.simulation.camera_path import camera_path
from calibslam_sim.simulation.random_streams import stream
from calibslam_sim.simulation.world import TABLE_HALF_SIZE, TABLE_HEIGHT, WorldObject

ROOM = np.array([-3.4, -3.1, 0.0, 3.4, 3.1, 2.8])  # [m] lower and upper corner
TABLE_EDGE = 0.05  # [m] beyond where things may stand
TABLE_THICKNESS = 0.03  # [m]
FOOT_HALF_SIZE = np.array([0.35, 0.2])  # [m] of what carries the table
SHADOW_SIZE = 600  # texels of shadows across the room: about 1 cm each
# An edge of the visible part nearer than this to that of the whole object is one and the same [px]: cast rays
# find it to half a pixel, geometry exactly.
SAME_EDGE = 1.5
JPEG_QUALITY = 92


@dataclass(frozen=True)
class RenderedImage:
    """One image and the truth about each of the N objects.

    Attributes:
        image: (H, W, 3) uint8, BGR as OpenCV has it.
        visible_boxes: (N, 4) of what is visible [px]; NaN where nothing is.
        whole_boxes: (N, 4) of the object without anything in front, cut at the image border [px]; NaN outside.
        visible_shares: (N,) visible pixels of those the image would show without anything in front.
        in_image_shares: (N,) area of the whole box that lies inside the image.
    """

    image: np.ndarray
    visible_boxes: Array
    whole_boxes: Array
    visible_shares: Array
    in_image_shares: Array

    def jpeg(self) -> bytes:
        """The image as a file."""
        done, data = cv2.imencode(".jpg", self.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            raise RuntimeError("OpenCV cannot encode JPEG")
        return bytes(data)


class Renderer:
    """Renders a world as a camera on `camera_path` sees it; the same arguments give the same images.

    Args:
        world: the objects.
        camera: without distortion.
        seed: of textures, light, optics and noise, and of the camera's path.
        pace: of the camera's path.
        family: of appearances, see `looks.FAMILIES`.
    """

    def __init__(self, world: tuple[WorldObject, ...], camera: Camera, seed: int, pace: float, family: str) -> None:
        self._camera, self._seed, self._pace = camera, seed, pace
        self._looks = looks(world, seed, family)
        self._T_world_object = np.array([o.ellipsoid.T_world_object for o in world])
        self._radii = np.array([o.ellipsoid.radii for o in world])
        self._centres = np.ascontiguousarray(self._T_world_object[:, :3, 3])
        rotations = self._T_world_object[:, :3, :3]
        self._whitening = np.ascontiguousarray(rotations.transpose(0, 2, 1) / self._radii[:, :, None])
        self._boxes = _table()
        self._shadows = np.empty((2, SHADOW_SIZE, SHADOW_SIZE), np.float32)
        for height, shadow in zip((0.0, TABLE_HEIGHT), self._shadows, strict=True):
            cast_shadows(height, ROOM, self._looks.light[:3], self._centres, self._whitening, shadow)

    def render(self, time: int) -> RenderedImage:
        """The image taken at `time` [ns], the middle of the exposure."""
        optics = self._looks.optics
        half = round(optics.exposure_time / 2.0 * SECOND)
        T_world_start, T_world_camera, T_world_end = camera_path(
            np.array([time - half, time, time + half]), self._pace, self._seed
        )
        K, shape = self._camera.K, (self._camera.height, self._camera.width)
        whole, in_image = self._project(T_world_camera)
        ids, depths = np.empty(shape, np.int16), np.empty(shape, np.float32)
        pixels_of_whole = np.empty(len(self._centres), np.int64)
        cast(
            K, T_world_camera, ROOM, self._boxes, self._centres, self._whitening, _rectangles(whole), ids, depths,
            pixels_of_whole,
        )  # fmt: skip
        light = np.empty((*shape, 3), np.float32)
        look = self._looks
        shade(
            K, T_world_camera, ids, depths, self._centres, self._whitening, look.patterns, look.numbers,
            look.colours, look.surfaces, look.lattice, look.light, ROOM, self._shadows, light,
        )  # fmt: skip
        T_end_start = np.linalg.inv(T_world_end) @ T_world_start
        light = optics.blur(light, depths, K, T_end_start, optics.focus_at(time))
        image = optics.expose(light, time, stream(self._seed, f"image noise at {time}"))
        pixels, visible = visible_parts(ids, len(self._centres))
        visible = np.where(np.abs(visible - whole) < SAME_EDGE, whole, visible)
        visible[pixels == 0] = np.nan
        return RenderedImage(
            image=np.ascontiguousarray(image[..., ::-1]),
            visible_boxes=visible,
            whole_boxes=whole,
            visible_shares=pixels / np.maximum(pixels_of_whole, 1),
            in_image_shares=in_image,
        )

    def _project(self, T_world_camera: Array) -> tuple[Array, Array]:
        """Boxes (N, 4) of the objects' parts inside the image, and which share (N,) of the whole boxes they are."""
        T_camera_object = np.linalg.inv(T_world_camera) @ self._T_world_object
        bounds = image_bounds(self._camera.width, self._camera.height)
        cut = project(T_camera_object, self._radii, self._camera.K, bounds)
        whole = project(T_camera_object, self._radii, self._camera.K)
        areas = [np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (cut, whole)]
        return cut, np.nan_to_num(areas[0] / areas[1])


def _rectangles(boxes: Array) -> np.ndarray:
    """Columns and rows (N, 4) that boxes (N, 4) touch: first, last plus one, of x and of y; none for NaN."""
    rectangles = np.zeros((len(boxes), 4), np.int64)
    seen = ~np.isnan(boxes[:, 0])
    rectangles[seen, 0::2] = np.floor(boxes[seen, :2])
    rectangles[seen, 1::2] = np.ceil(boxes[seen, 2:])
    return rectangles


def _table() -> Array:
    """Solid boxes (2, 6): the table's top and what carries it."""
    half = TABLE_HALF_SIZE + TABLE_EDGE
    bottom = TABLE_HEIGHT - TABLE_THICKNESS
    return np.array(
        [
            [*-half, bottom, *half, TABLE_HEIGHT],
            [*-FOOT_HALF_SIZE, 0.0, *FOOT_HALF_SIZE, bottom],
        ]
    )
