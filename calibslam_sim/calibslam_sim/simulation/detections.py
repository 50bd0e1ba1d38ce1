"""A detector of the simulated world: boxes of projected ellipsoids, with errors of known covariance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calibslam_backend.geometry.visible_box import image_bounds, project
from calibslam_msgs_py.measurements import SECOND, Array, Boxes, Camera
from calibslam_sim.simulation.box_noise import BoxConditions, BoxNoise
from calibslam_sim.simulation.gross_errors import add_gross_errors
from calibslam_sim.simulation.occlusion import hidden_shares
from calibslam_sim.simulation.random_streams import stream
from calibslam_sim.simulation.world import WorldObject


@dataclass(frozen=True)
class Detector:
    """What the simulated detector finds.

    Attributes:
        noise: error of the boxes.
        max_hidden: an object hidden by more than this share by others gives no box; a less hidden one gives
            the box of the whole object, with a larger error.
        min_in_image: an object of which less than this share of the box lies inside the image gives no box.
        min_size: neither does one whose box is narrower or lower [px].
        miss_rate: probability of missing an object that is easy to see; grows with what hides it.
        gross_share: share of boxes with a gross error, see `gross_errors`.
        error_memory: time [s] in which the errors of an object's boxes become unlike by a factor of e, 0: independent.
    """

    noise: BoxNoise = field(default_factory=BoxNoise)
    max_hidden: float = 0.3
    min_in_image: float = 0.4
    min_size: float = 8.0
    miss_rate: float = 0.1
    gross_share: float = 0.0
    error_memory: float = 0.0

    def detect(
        self,
        camera: Camera,
        world: tuple[WorldObject, ...],
        times: np.ndarray,
        T_world_camera: Array,
        seed: int,
    ) -> list[Boxes]:
        """The boxes of each image, taken at `times` (F,) [ns] from poses (F, 4, 4).

        Errors have the stated covariance before boxes are cut at the border. So the border that cuts an object is drawn
        as inaccurately as its own edges, half of the time inside the image, as real detectors do.
        """
        whole, visible = _project_all(camera, world, T_world_camera)
        hidden = hidden_shares([o.ellipsoid for o in world], T_world_camera[:, :3, 3])
        sizes = visible[..., 2:] - visible[..., :2]
        whole_sizes = whole[..., 2:] - whole[..., :2]
        in_image = np.nan_to_num(np.prod(sizes, axis=-1) / np.prod(whole_sizes, axis=-1))
        bounds = image_bounds(camera.width, camera.height)
        covariances = self.noise.covariances(
            BoxConditions(
                extents=sizes,
                hidden=hidden,
                is_cut=(visible == bounds).any(axis=-1),
                image_motion=_image_motion(whole),
                edge_difficulty=np.array([o.edge_difficulty for o in world]),
                edge_correlation=np.array([o.edge_correlation for o in world]),
            )
        )
        # Drawn for every object in every image, seen or not: what is seen does not shift anybody's numbers.
        draws = self._remembered(stream(seed, "box noise").standard_normal(visible.shape), times)
        luck = stream(seed, "missed boxes").random(hidden.shape)
        jitter = stream(seed, "scores").standard_normal(hidden.shape)

        clarity = (1.0 - hidden / self.max_hidden) * in_image
        found = (hidden <= self.max_hidden) & (in_image >= self.min_in_image)
        found &= np.nan_to_num(sizes.min(axis=-1)) >= self.min_size
        found &= luck >= 1.0 - (1.0 - self.miss_rate) * np.clip(0.5 + clarity, 0.0, 1.0)
        scores = np.clip(0.6 + 0.35 * clarity + 0.05 * jitter, 0.5, 0.99)

        gross = stream(seed, "gross errors")
        classes = tuple(sorted({o.class_id for o in world}))
        images = []
        for f, time in enumerate(times):
            seen = np.flatnonzero(found[f])
            errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances[f, seen]), draws[f, seen])
            boxes = Boxes(
                stamp=int(time),
                width=camera.width,
                height=camera.height,
                corners=visible[f, seen] + errors,
                covariances=covariances[f, seen],
                class_ids=tuple(world[i].class_id for i in seen),
                scores=scores[f, seen],
                object_ids=tuple(str(world[i].id) for i in seen),
                frame_id=camera.frame_id,
            )
            boxes = add_gross_errors(boxes, self.gross_share, classes, gross)
            images.append(_cut_at_border(boxes, bounds))
        return images

    def _remembered(self, draws: Array, times: np.ndarray) -> Array:
        """Normal draws (F, ...) that are alike from image to image: an autoregressive process of first order."""
        if self.error_memory == 0.0:
            return draws
        result = draws.copy()
        for f, seconds in enumerate(np.diff(times) / SECOND, start=1):
            kept = np.exp(-seconds / self.error_memory)
            result[f] = kept * result[f - 1] + np.sqrt(1.0 - kept**2) * draws[f]
        return result


def _project_all(camera: Camera, world: tuple[WorldObject, ...], T_world_camera: Array) -> tuple[Array, Array]:
    """Boxes (F, N, 4) [px] of whole objects and of their parts inside the image; NaN where there is none."""
    T_camera_world = np.linalg.inv(T_world_camera)
    T_world_object = np.array([o.ellipsoid.T_world_object for o in world])
    T_camera_object = np.einsum("fij,njk->fnik", T_camera_world, T_world_object).reshape(-1, 4, 4)
    radii = np.tile([o.ellipsoid.radii for o in world], (len(T_world_camera), 1))
    shape = (len(T_world_camera), len(world), 4)
    whole = project(T_camera_object, radii, camera.K).reshape(shape)
    bounds = image_bounds(camera.width, camera.height)
    return whole, project(T_camera_object, radii, camera.K, bounds).reshape(shape)


def _image_motion(boxes: Array) -> Array:
    """Motion (F, N, 2) of box centres (F, N, 4) since the image before [px]; zero where unknown."""
    centres = (boxes[..., :2] + boxes[..., 2:]) / 2.0
    motion = np.zeros_like(centres)
    motion[1:] = np.diff(centres, axis=0)
    return np.nan_to_num(motion)


def _cut_at_border(boxes: Boxes, bounds: Array) -> Boxes:
    """The boxes cut at the image border, without those of which nothing is left."""
    corners = np.clip(boxes.corners, np.tile(bounds[:2], 2), np.tile(bounds[2:], 2))
    kept = np.flatnonzero((corners[:, 2] - corners[:, 0] > 0.0) & (corners[:, 3] - corners[:, 1] > 0.0))
    return replace(
        boxes,
        corners=corners[kept],
        covariances=boxes.covariances[kept],
        class_ids=tuple(boxes.class_ids[i] for i in kept),
        scores=boxes.scores[kept],
        object_ids=tuple(boxes.object_ids[i] for i in kept),
    )
