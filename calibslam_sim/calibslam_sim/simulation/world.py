"""The desk world: a table with things on it and chairs around it, each one an ellipsoid.

World frame: z up, origin on the floor below the middle of the table. The table itself is drawn by nobody and
hides nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_msgs_py.measurements import Array
from calibslam_sim.simulation.random_streams import stream

TABLE_HEIGHT = 0.74
TABLE_HALF_SIZE = np.array([1.0, 0.7])
CHAIR_RING = (1.15, 1.45)  # where chairs stand, as a multiple of the table's half size
CLEARANCE = 0.02  # [m] between neighbours
ATTEMPTS_PER_OBJECT = 200
ATTEMPTS_PER_LAYOUT = 100


@dataclass(frozen=True)
class Kind:
    """A kind of object: mean semi-axes [m] and how much worse than average a detector draws its boxes."""

    class_id: str
    count: int
    radii: tuple[float, float, float]
    difficulty: float


# Large things first: a layout then rarely fails.
ON_TABLE = (
    Kind("tv", 2, (0.28, 0.07, 0.19), 0.6),
    Kind("laptop", 1, (0.18, 0.14, 0.11), 1.0),
    Kind("keyboard", 2, (0.22, 0.08, 0.025), 1.4),
    Kind("teddy bear", 1, (0.13, 0.12, 0.17), 1.0),
    Kind("potted plant", 1, (0.11, 0.11, 0.18), 1.8),
    Kind("book", 3, (0.13, 0.09, 0.03), 2.0),
    Kind("bottle", 2, (0.04, 0.04, 0.13), 0.8),
    Kind("mouse", 1, (0.06, 0.035, 0.025), 1.0),
    Kind("cup", 3, (0.05, 0.045, 0.055), 0.7),
)
AROUND_TABLE = (Kind("chair", 3, (0.27, 0.26, 0.45), 1.6),)


@dataclass(frozen=True)
class WorldObject:
    """One object of the world.

    Attributes:
        id: its identity, also the place in the world's list.
        class_id: COCO name.
        ellipsoid: its shape in the world.
        edge_difficulty: (4,) factor on the detector's error of each box edge, xmin ymin xmax ymax.
        edge_correlation: correlation of the errors of opposite edges.
    """

    id: int
    class_id: str
    ellipsoid: Ellipsoid
    edge_difficulty: Array
    edge_correlation: float


def desk_world(seed: int) -> tuple[WorldObject, ...]:
    """A desk with 16 objects on it and 3 chairs around it; the seed decides where and how large they are."""
    looks = stream(seed, "object appearance")
    kinds = [kind for kind in ON_TABLE + AROUND_TABLE for _ in range(kind.count)]
    again, attempt = "", 1
    while True:
        shapes = stream(seed, f"object shapes{again}")
        radii = [np.array(kind.radii) * np.exp(0.12 * shapes.standard_normal(3)) for kind in kinds]
        centres = _layout([max(r[0], r[1]) for r in radii], stream(seed, f"layout{again}"))
        if centres is not None:
            break
        # One seed in some thousands draws objects too large for the table: they are drawn anew, from other streams.
        attempt += 1
        again = f", attempt {attempt}"
    objects = []
    for i, kind in enumerate(kinds):
        stands_on = TABLE_HEIGHT if kind in ON_TABLE else 0.0
        yaw = shapes.uniform(-np.pi, np.pi)
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = [*centres[i], stands_on + radii[i][2]]
        difficulty = kind.difficulty * np.exp(0.3 * looks.standard_normal() + 0.25 * looks.standard_normal(4))
        objects.append(
            WorldObject(i, kind.class_id, Ellipsoid(T, radii[i]), difficulty, float(looks.uniform(-0.3, 0.6)))
        )
    return tuple(objects)


def _layout(footprints: list[float], rng: np.random.Generator) -> list[Array] | None:
    """Places (2,) [m] at which circles of these radii do not overlap; chairs stand around the table. None: no luck."""
    on_table = sum(kind.count for kind in ON_TABLE)
    for _ in range(ATTEMPTS_PER_LAYOUT):
        places: list[Array] = []
        for i, footprint in enumerate(footprints):
            for _ in range(ATTEMPTS_PER_OBJECT):
                place = _on_table(footprint, rng) if i < on_table else _around_table(rng)
                if all(
                    np.hypot(*(place - other)) > footprint + footprints[j] + CLEARANCE for j, other in enumerate(places)
                ):
                    places.append(place)
                    break
            else:
                break
        if len(places) == len(footprints):
            return places
    return None


def _on_table(footprint: float, rng: np.random.Generator) -> Array:
    reach = TABLE_HALF_SIZE - footprint
    return np.asarray(rng.uniform(-reach, reach))


def _around_table(rng: np.random.Generator) -> Array:
    angle = rng.uniform(-np.pi, np.pi)
    return np.asarray(rng.uniform(*CHAIR_RING) * TABLE_HALF_SIZE * [np.cos(angle), np.sin(angle)])
