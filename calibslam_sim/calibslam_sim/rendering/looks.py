"""What things look like: a family of appearances gives every class its colours and pattern, with variation.

A network is trained on one family; of the other, "foreign", it knows neither textures nor light nor camera.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_sim.rendering.kernels import (
    BANDS,
    CHECKS,
    DOTS,
    KEYS,
    LABEL,
    MARBLE,
    MOTTLED,
    NOISE_SIZE,
    POT,
    SCREEN,
    STRIPES,
)
from calibslam_sim.rendering.optics import Optics
from calibslam_sim.simulation.random_streams import stream
from calibslam_sim.simulation.world import WorldObject

FAMILIES = ("familiar", "foreign")
TEXTURE_SIZE = 512  # texels
Hsv = tuple[float, float, float]


@dataclass(frozen=True)
class ClassLook:
    """How a class looks.

    Attributes:
        pattern: of `kernels.PATTERNS`.
        colours: three, as hue, saturation, value.
        hue_spread: standard deviation of the hue of the second colour between objects.
        frequency: of the pattern.
        gloss: strength of the highlight.
    """

    pattern: int
    colours: tuple[Hsv, Hsv, Hsv]
    hue_spread: float
    frequency: float
    gloss: float


WHITE, GREY, BLACK = (0.1, 0.05, 0.85), (0.6, 0.05, 0.45), (0.6, 0.1, 0.06)
FAMILIAR = {
    "tv": ClassLook(SCREEN, (BLACK, (0.58, 0.6, 0.45), (0.6, 0.1, 0.15)), 0.04, 4.0, 0.3),
    "laptop": ClassLook(KEYS, ((0.58, 0.06, 0.55), BLACK, WHITE), 0.02, 4.0, 0.3),
    "keyboard": ClassLook(KEYS, (BLACK, (0.1, 0.08, 0.7), GREY), 0.05, 3.0, 0.05),
    "teddy bear": ClassLook(MOTTLED, ((0.08, 0.7, 0.25), (0.09, 0.6, 0.6), BLACK), 0.01, 4.0, 0.0),
    "potted plant": ClassLook(POT, ((0.33, 0.8, 0.18), (0.28, 0.7, 0.6), (0.04, 0.7, 0.55)), 0.02, 4.0, 0.1),
    "book": ClassLook(STRIPES, (WHITE, (0.0, 0.8, 0.6), GREY), 0.03, 5.0, 0.1),
    "bottle": ClassLook(LABEL, ((0.45, 0.7, 0.35), WHITE, (0.02, 0.7, 0.6)), 0.03, 4.0, 0.9),
    "mouse": ClassLook(STRIPES, ((0.6, 0.08, 0.3), (0.75, 0.5, 0.6), WHITE), 0.03, 1.2, 0.5),
    "cup": ClassLook(BANDS, (WHITE, (0.62, 0.8, 0.5), GREY), 0.05, 3.0, 0.7),
    "chair": ClassLook(MARBLE, ((0.09, 0.6, 0.35), (0.07, 0.5, 0.6), BLACK), 0.01, 9.0, 0.1),
}
FOREIGN = {
    "tv": ClassLook(CHECKS, ((0.7, 0.4, 0.2), (0.62, 0.3, 0.5), GREY), 0.08, 3.0, 0.6),
    "laptop": ClassLook(BANDS, ((0.15, 0.2, 0.6), (0.5, 0.3, 0.3), WHITE), 0.08, 6.0, 0.1),
    "keyboard": ClassLook(DOTS, ((0.1, 0.1, 0.75), (0.6, 0.2, 0.2), BLACK), 0.08, 5.0, 0.0),
    "teddy bear": ClassLook(STRIPES, ((0.95, 0.4, 0.6), (0.05, 0.4, 0.7), WHITE), 0.05, 4.0, 0.0),
    "potted plant": ClassLook(MARBLE, ((0.22, 0.7, 0.35), (0.4, 0.6, 0.4), WHITE), 0.05, 12.0, 0.3),
    "book": ClassLook(CHECKS, ((0.55, 0.6, 0.5), (0.13, 0.7, 0.7), GREY), 0.2, 4.0, 0.0),
    "bottle": ClassLook(MARBLE, ((0.05, 0.6, 0.4), (0.1, 0.3, 0.7), WHITE), 0.1, 5.0, 0.9),
    "mouse": ClassLook(DOTS, ((0.0, 0.1, 0.8), (0.3, 0.6, 0.5), BLACK), 0.2, 2.0, 0.8),
    "cup": ClassLook(MOTTLED, ((0.1, 0.6, 0.7), (0.8, 0.4, 0.5), GREY), 0.2, 3.0, 0.2),
    "chair": ClassLook(DOTS, ((0.66, 0.4, 0.3), (0.5, 0.2, 0.7), BLACK), 0.1, 6.0, 0.2),
}


@dataclass(frozen=True)
class Looks:
    """How one world looks; the arrays are those of `kernels.shade`."""

    patterns: np.ndarray
    numbers: Array
    colours: Array
    surfaces: np.ndarray
    lattice: np.ndarray
    light: Array
    optics: Optics


def looks(world: tuple[WorldObject, ...], seed: int, family: str) -> Looks:
    """The looks of a world in a family of `FAMILIES`; the seed varies everything within the family."""
    foreign = family == "foreign"
    rng = stream(seed, f"{family} looks")
    classes = FOREIGN if foreign else FAMILIAR
    of_objects = [classes[thing.class_id] for thing in world]
    return Looks(
        patterns=np.array([look.pattern for look in of_objects]),
        numbers=np.array(
            [
                [look.frequency * np.exp(0.15 * rng.standard_normal()), rng.uniform(0.0, 10.0), look.gloss]
                for look in of_objects
            ]
        ),
        colours=np.array([_object_colours(look, rng) for look in of_objects]),
        surfaces=_surfaces(foreign, rng),
        lattice=rng.random((NOISE_SIZE,) * 3),
        light=_light(foreign, rng),
        optics=_optics(foreign, rng),
    )


def _object_colours(look: ClassLook, rng: np.random.Generator) -> Array:
    """Three colours (3, 3), linear RGB."""
    colours = []
    for k, (hue, saturation, value) in enumerate(look.colours):
        hue += (look.hue_spread if k == 1 else 0.01) * rng.standard_normal()
        saturation = min(saturation * np.exp(0.15 * rng.standard_normal()), 1.0)
        value = min(value * np.exp(0.2 * rng.standard_normal()), 0.95)
        colours.append(colorsys.hsv_to_rgb(hue % 1.0, saturation, value))
    return np.array(colours)


def _light(foreign: bool, rng: np.random.Generator) -> Array:
    """Lamp: position [m], colour, ambient share, range [m], see `kernels.shade`."""
    position = [*rng.uniform(-1.6, 1.6, 2), rng.uniform(1.3, 1.7) if foreign else rng.uniform(1.9, 2.5)]
    warmth = rng.normal(0.0, 0.1)
    colour = [1.1, 0.6, 0.75] if foreign else [1.0 + warmth, 1.0, 1.0 - warmth]
    return np.array([*position, *colour, rng.uniform(0.1, 0.2) if foreign else rng.uniform(0.25, 0.6), 2.0])


def _optics(foreign: bool, rng: np.random.Generator) -> Optics:
    darkness = rng.uniform(0.0, 1.0)  # a dark room: long exposure, open aperture, much noise
    if foreign:
        darkness += 0.8
    return Optics(
        exposure_time=0.004 + 0.018 * darkness,
        aperture=0.5 + 6.0 * rng.uniform() * darkness,
        focus=(rng.uniform(1.4, 2.6), rng.uniform(0.05, 0.35)),
        shot_noise=2e-4 * 15.0**darkness,
        read_noise=1e-3 * 8.0**darkness,
        brightness=rng.uniform(0.12, 0.25),
        exposure_error=rng.uniform(0.0, 0.4),
        gamma=1.6 if foreign else 2.2,
        tint=(0.85, 1.0, 1.15) if foreign else (1.0, 1.0, 1.0),
        vignetting=rng.uniform(0.5, 0.7) if foreign else rng.uniform(0.05, 0.3),
    )


def _surfaces(foreign: bool, rng: np.random.Generator) -> np.ndarray:
    """Textures (6, S, S, 3) float32 of two walls, floor, ceiling, table top and its sides."""
    wall = _hsv(rng.uniform(0.0, 1.0), rng.uniform(0.0, 0.25), rng.uniform(0.45, 0.8))
    floor = _hsv(rng.uniform(0.0, 1.0), rng.uniform(0.05, 0.35), rng.uniform(0.15, 0.45))
    wood = _hsv(rng.uniform(0.05, 0.13), rng.uniform(0.15, 0.5), rng.uniform(0.35, 0.75))
    if foreign:
        wall, floor, wood = (_hsv(rng.uniform(0.0, 1.0), rng.uniform(0.4, 0.7), 0.6) for _ in range(3))
    textures = [
        _with_posters(_grainy(wall, (6, 6), 0.1, rng), rng),
        _with_posters(_grainy(wall, (6, 6), 0.1, rng), rng),
        _grainy(floor, (8, 128), 0.5, rng),
        _grainy(wall, (4, 4), 0.05, rng),
        _grainy(wood, (96, 8), 0.35, rng),
        _grainy(0.6 * wood, (64, 8), 0.3, rng),
    ]
    if foreign:  # tiles
        cells = np.indices((TEXTURE_SIZE, TEXTURE_SIZE)).sum(axis=0) // 24 % 2
        textures = [texture * (0.6 + 0.5 * cells[..., None]) for texture in textures]
    return np.clip(np.stack(textures), 0.01, 1.0).astype(np.float32)


def _grainy(colour: Array, cells: tuple[int, int], contrast: float, rng: np.random.Generator) -> Array:
    """A colour with noise of so many rows and columns, and finer noise on it."""
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    coarse = cv2.resize(rng.standard_normal(cells), size, interpolation=cv2.INTER_CUBIC)
    fine = cv2.resize(rng.standard_normal((128, 128)), size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(colour * np.exp(contrast * (coarse + 0.3 * fine))[..., None])


def _with_posters(texture: Array, rng: np.random.Generator) -> Array:
    """Rectangles of any colour on a wall: things a network must not take for objects."""
    for _ in range(rng.integers(2, 7)):
        left, low = rng.integers(0, TEXTURE_SIZE - 100, 2)
        width, height = rng.integers(20, 100, 2)
        poster = texture[low : low + height, left : left + width]
        poster[:] = _hsv(*rng.uniform([0.0, 0.0, 0.1], [1.0, 0.8, 0.8]))
        stripe = rng.integers(4, 16)
        poster[:: stripe * 2] = _hsv(*rng.uniform([0.0, 0.0, 0.1], [1.0, 0.8, 0.8]))
    return texture


def _hsv(hue: float, saturation: float, value: float) -> Array:
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value))
