"""What a camera makes of the light that reaches it: motion blur, defocus, exposure, noise, tone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numba
import numpy as np

from calibslam_msgs_py.measurements import SECOND, Array

LENS_BLUR = 0.55  # [px] standard deviation of a lens in focus; also what smooths the edges of cast rays
MAX_SAMPLES = 24  # of the blur of a pixel
TONE_LEVELS = 4096


def _blur_samples() -> Array:
    """For each number of samples n: n places on the unit disc and times in (-1/2, 1/2), (n, sample, x y time).

    A sunflower's spiral; places have nothing to do with times: a permutation keeps them apart.
    """
    table = np.zeros((MAX_SAMPLES + 1, MAX_SAMPLES, 3))
    for n in range(1, MAX_SAMPLES + 1):
        s = np.arange(n)
        radius, angle = np.sqrt((s + 0.5) / n), s * np.pi * (3.0 - np.sqrt(5.0))
        times = ((s * 29) % n + 0.5) / n - 0.5
        table[n, :n] = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), times])
    return table


BLUR_SAMPLES = _blur_samples()


@dataclass(frozen=True)
class Optics:
    """One camera in one light.

    Attributes:
        exposure_time: how long the shutter is open [s].
        aperture: radius of the blur disc of a point at distance z focused at f is aperture |1/z - 1/f| [px m].
        focus: mean focus distance, and how far focus wanders about it, as a logarithm [m].
        shot_noise: variance of the noise per unit of light, in units of full scale.
        read_noise: standard deviation of the noise without light, in units of full scale.
        brightness: mean of the image, linear, in units of full scale, that exposure aims at.
        exposure_error: how far exposure wanders from that, as a logarithm.
        gamma: of the tone curve.
        tint: (3,) gain of red, green and blue.
        vignetting: light lost in the corners.
    """

    exposure_time: float
    aperture: float
    focus: tuple[float, float]
    shot_noise: float
    read_noise: float
    brightness: float
    exposure_error: float
    gamma: float
    tint: tuple[float, float, float]
    vignetting: float

    def focus_at(self, time: int) -> float:
        """Focus distance [m] at a time [ns]: it hunts slowly."""
        t = time / SECOND
        return self.focus[0] * math.exp(self.focus[1] * (math.sin(0.7 * t) + 0.5 * math.sin(1.9 * t + 1.0)))

    def blur(self, light: np.ndarray, depths: np.ndarray, K: Array, T_end_start: Array, focus: float) -> np.ndarray:
        """Light (H, W, 3) float32 smeared by the motion while the shutter is open, and out of focus.

        Args:
            light: sharp, float32.
            depths: (H, W) [m].
            T_end_start: (4, 4) the camera when the shutter opens, in the camera when it closes.
            focus: distance [m].
        """
        smeared = np.empty_like(light)
        _smear(light, depths, K, T_end_start, self.aperture, 1.0 / focus, smeared)
        return np.asarray(cv2.GaussianBlur(smeared, (5, 5), LENS_BLUR))

    def expose(self, light: np.ndarray, time: int, rng: np.random.Generator) -> np.ndarray:
        """The image (H, W, 3) uint8 of this light, channels as they come (RGB)."""
        t = time / SECOND
        error = self.exposure_error * (math.sin(0.43 * t) + 0.5 * math.sin(1.3 * t + 2.0))
        gain = self.brightness * math.exp(error) / max(float(light.mean()), 1e-6)
        levels = np.empty(light.shape, np.uint16)
        noise = rng.standard_normal(light.shape, np.float32)
        gains = gain * np.array(self.tint)
        _record(light, noise, gains, self.vignetting, self.shot_noise, self.read_noise, levels)
        tone = np.rint(255.0 * np.linspace(0.0, 1.0, TONE_LEVELS) ** (1.0 / self.gamma)).astype(np.uint8)
        return np.asarray(tone[levels])


@numba.njit(cache=True)
def _smear(light, depths, K, T_end_start, aperture, inverse_focus, out):  # type: ignore[no-untyped-def]
    """Gathers each pixel's light along its motion and over its blur disc."""
    height, width = depths.shape
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    T = T_end_start
    for i in range(height):
        for j in range(width):
            z = depths[i, j]
            x, y = (j + 0.5 - cx) / fx * z, (i + 0.5 - cy) / fy * z
            ex = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            ey = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            ez = max(T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3], 1e-3)
            flow_x, flow_y = fx * ex / ez + cx - (j + 0.5), fy * ey / ez + cy - (i + 0.5)
            disc = aperture * abs(1.0 / z - inverse_focus)
            extent = math.sqrt(flow_x * flow_x + flow_y * flow_y) + 2.0 * disc
            if extent < 0.5:
                for a in range(3):
                    out[i, j, a] = light[i, j, a]
                continue
            samples = min(3 + int(1.5 * extent), MAX_SAMPLES)
            red, green, blue = 0.0, 0.0, 0.0
            for s in range(samples):
                u = j + BLUR_SAMPLES[samples, s, 2] * flow_x + disc * BLUR_SAMPLES[samples, s, 0]
                v = i + BLUR_SAMPLES[samples, s, 2] * flow_y + disc * BLUR_SAMPLES[samples, s, 1]
                u, v = min(max(u, 0.0), width - 1.001), min(max(v, 0.0), height - 1.001)
                c, w = int(u), int(v)
                u, v = u - c, v - w
                a00, a01, a10, a11 = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
                e, f = c + 1, w + 1
                red += a00 * light[w, c, 0] + a01 * light[w, e, 0] + a10 * light[f, c, 0] + a11 * light[f, e, 0]
                green += a00 * light[w, c, 1] + a01 * light[w, e, 1] + a10 * light[f, c, 1] + a11 * light[f, e, 1]
                blue += a00 * light[w, c, 2] + a01 * light[w, e, 2] + a10 * light[f, c, 2] + a11 * light[f, e, 2]
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = red / samples, green / samples, blue / samples


@numba.njit(cache=True)
def _record(light, noise, gains, vignetting, shot_noise, read_noise, levels):  # type: ignore[no-untyped-def]
    """What the sensor counts, 0 to TONE_LEVELS - 1: less in the corners, with noise of unit variance given."""
    height, width = light.shape[:2]
    for i in range(height):
        for j in range(width):
            radius2 = ((j - width / 2) ** 2 + (i - height / 2) ** 2) / ((width**2 + height**2) / 4)
            for a in range(3):
                signal = light[i, j, a] * gains[a] * (1.0 - vignetting * radius2)
                signal += math.sqrt(shot_noise * signal + read_noise**2) * noise[i, j, a]
                levels[i, j, a] = int(min(max(signal, 0.0), 1.0) * (TONE_LEVELS - 1))
