"""Ray casting and shading of a room with ellipsoids, compiled.

Pixel (i, j) looks along the ray through (j + 0.5, i + 0.5): the image covers [0, width] x [0, height].
Depth is along the optical axis [m]. Colours are linear light, RGB.
"""

from __future__ import annotations

import math

import numba
import numpy as np

# What a pixel sees where it sees no object: negative ids.
WALL_X, WALL_Y, FLOOR, CEILING, TABLE, TABLE_SIDE = -1, -2, -3, -4, -5, -6
# Patterns of objects, by what they depend on; q are coordinates in which the ellipsoid is the unit sphere.
PATTERNS = ("mottled", "bands", "stripes", "checks", "dots", "pot", "marble", "label", "screen", "keys")
MOTTLED, BANDS, STRIPES, CHECKS, DOTS, POT, MARBLE, LABEL, SCREEN, KEYS = range(len(PATTERNS))
TEXELS = 96  # per metre of a texture of the room
NO_SHADOW = 1.5  # squared distance, in the coordinates of the unit sphere, from where the lamp is seen whole
NOISE_SIZE = 32  # cells of the periodic noise in each direction


@numba.njit(cache=True)
def cast(K, T_world_camera, room, boxes, centres, whitening, rectangles, ids, depths, whole):  # type: ignore[no-untyped-def]
    """What each pixel sees.

    Args:
        K: (3, 3); T_world_camera: (4, 4).
        room: (6,) lower and upper corner of the room, the camera inside [m].
        boxes: (B, 6) solid boxes; the first is the table's top.
        centres: (N, 3) of ellipsoids; whitening: (N, 3, 3) maps world directions to unit-sphere coordinates.
        rectangles: (N, 4) first and last-plus-one column and row to search each ellipsoid in.
        ids: (H, W) int16, written: index of the ellipsoid, or what of the room.
        depths: (H, W) float32, written.
        whole: (N,) written: pixels of the ellipsoid, hidden ones included.
    """
    height, width = ids.shape
    R = np.ascontiguousarray(T_world_camera[:3, :3])
    eye = np.ascontiguousarray(T_world_camera[:3, 3])
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for i in range(height):
        y = (i + 0.5 - cy) / fy
        for j in range(width):
            x = (j + 0.5 - cx) / fx
            nearest, surface = 1e9, WALL_X
            for a in range(3):
                d = R[a, 0] * x + R[a, 1] * y + R[a, 2]
                if abs(d) > 1e-9:
                    t = ((room[3 + a] if d > 0.0 else room[a]) - eye[a]) / d
                    if t < nearest:
                        nearest = t
                        surface = WALL_X if a == 0 else WALL_Y if a == 1 else (CEILING if d > 0.0 else FLOOR)
            for b in range(len(boxes)):
                near, far, face = -1e9, 1e9, 0
                for a in range(3):
                    d = R[a, 0] * x + R[a, 1] * y + R[a, 2]
                    if abs(d) < 1e-9:
                        d = 1e-9
                    t0, t1 = (boxes[b, a] - eye[a]) / d, (boxes[b, 3 + a] - eye[a]) / d
                    if t0 > t1:
                        t0, t1 = t1, t0
                    if t0 > near:
                        near, face = t0, a
                    far = min(far, t1)
                if 0.0 < near < far and near < nearest:
                    nearest = near
                    surface = TABLE if b == 0 and face == 2 else TABLE_SIDE
            ids[i, j] = surface
            depths[i, j] = nearest
    for n in range(len(centres)):
        A = whitening[n] @ R
        o = whitening[n] @ (eye - centres[n])
        c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - 1.0
        whole[n] = 0
        for i in range(rectangles[n, 2], rectangles[n, 3]):
            y = (i + 0.5 - cy) / fy
            for j in range(rectangles[n, 0], rectangles[n, 1]):
                x = (j + 0.5 - cx) / fx
                d0 = A[0, 0] * x + A[0, 1] * y + A[0, 2]
                d1 = A[1, 0] * x + A[1, 1] * y + A[1, 2]
                d2 = A[2, 0] * x + A[2, 1] * y + A[2, 2]
                a = d0 * d0 + d1 * d1 + d2 * d2
                b = o[0] * d0 + o[1] * d1 + o[2] * d2
                root = b * b - a * c
                if root > 0.0:
                    t = (-b - math.sqrt(root)) / a
                    if t > 0.0:
                        whole[n] += 1
                        if t < depths[i, j]:
                            depths[i, j] = t
                            ids[i, j] = n


@numba.njit(cache=True)
def visible_parts(ids, count):  # type: ignore[no-untyped-def]
    """Pixels (N,) of each object, and their box (N, 4) xmin ymin xmax ymax [px]; (0, 0, 0, 0) without pixels."""
    pixels = np.zeros(count, np.int64)
    boxes = np.zeros((count, 4))
    for i in range(ids.shape[0]):
        for j in range(ids.shape[1]):
            n = ids[i, j]
            if n < 0:
                continue
            if pixels[n] == 0:
                boxes[n, 0], boxes[n, 1], boxes[n, 2] = j, i, j + 1
            pixels[n] += 1
            boxes[n, 0] = min(boxes[n, 0], j)
            boxes[n, 2] = max(boxes[n, 2], j + 1)
            boxes[n, 3] = i + 1
    return pixels, boxes


@numba.njit(cache=True)
def _noise(lattice, x, y, z):  # type: ignore[no-untyped-def]
    """Value noise in [0, 1]: trilinear between the periodic lattice's random numbers."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    x, y, z = x - fx, y - fy, z - fz
    i, j, k = int(fx) % NOISE_SIZE, int(fy) % NOISE_SIZE, int(fz) % NOISE_SIZE
    i1, j1, k1 = (i + 1) % NOISE_SIZE, (j + 1) % NOISE_SIZE, (k + 1) % NOISE_SIZE
    low = (lattice[i, j, k] * (1 - x) + lattice[i1, j, k] * x) * (1 - y)
    low += (lattice[i, j1, k] * (1 - x) + lattice[i1, j1, k] * x) * y
    high = (lattice[i, j, k1] * (1 - x) + lattice[i1, j, k1] * x) * (1 - y)
    high += (lattice[i, j1, k1] * (1 - x) + lattice[i1, j1, k1] * x) * y
    return low * (1 - z) + high * z


@numba.njit(cache=True)
def _shares(pattern, q, frequency, phase, lattice):  # type: ignore[no-untyped-def]
    """How much of an object's second and third colour its surface has at q, each in [0, 1]."""
    grain = _noise(lattice, 4.0 * q[0] + phase, 4.0 * q[1], 4.0 * q[2])
    if pattern == MOTTLED:
        fine = _noise(lattice, 3.0 * frequency * q[0], 3.0 * frequency * q[1] + phase, 3.0 * frequency * q[2])
        return fine, 0.3 * grain
    if pattern == BANDS:
        return 1.0 if math.sin(math.pi * frequency * (q[2] + 0.1 * phase)) > 0.2 else 0.0, 0.2 * grain
    if pattern == STRIPES:
        return 1.0 if math.sin(math.pi * frequency * (q[0] + 0.1 * phase)) > 0.3 else 0.0, 0.2 * grain
    if pattern == CHECKS:
        cells = math.floor(frequency * q[0]) + math.floor(frequency * q[1]) + math.floor(frequency * q[2])
        return float(int(cells) & 1), 0.2 * grain
    if pattern == DOTS:
        r = 0.0
        for a in range(3):
            offset = frequency * q[a] - math.floor(frequency * q[a]) - 0.5
            r += offset * offset
        return 1.0 if r < 0.16 else 0.0, 0.2 * grain
    if pattern == POT:
        leaves = _noise(lattice, 5.0 * q[0] + phase, 5.0 * q[1], 5.0 * q[2])
        return (0.0, 1.0) if q[2] < -0.35 + 0.1 * (grain - 0.5) else (1.5 * max(leaves - 0.35, 0.0), 0.0)
    if pattern == MARBLE:
        return 0.5 + 0.5 * math.sin(frequency * (q[2] + 0.4 * q[0]) + 6.0 * grain + phase), 0.0
    if pattern == LABEL:
        return 1.0 if abs(q[2] + 0.1) < 0.3 else 0.0, 1.0 if q[2] > 0.72 else 0.0
    if pattern == SCREEN:
        glow = 0.6 + 0.4 * math.sin(frequency * q[0] + phase) * math.sin(frequency * q[2])
        return glow if abs(q[0]) < 0.75 and abs(q[2]) < 0.7 else 0.0, 0.1 * grain
    row, column = frequency * q[1], 2.0 * frequency * q[0]
    key = row - math.floor(row) > 0.25 and column - math.floor(column) > 0.25
    return 1.0 if key and abs(q[0]) < 0.85 and abs(q[1]) < 0.8 and q[2] > 0.0 else 0.0, 0.15 * grain


@numba.njit(cache=True)
def _squared_distance(a, b, c):  # type: ignore[no-untyped-def]
    """Of a point c (3,) from the line between a and b (3,)."""
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    x, y, z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    along = min(max((x * dx + y * dy + z * dz) / (dx * dx + dy * dy + dz * dz), 0.0), 1.0)
    return (x - along * dx) ** 2 + (y - along * dy) ** 2 + (z - along * dz) ** 2


@numba.njit(cache=True)
def cast_shadows(height, room, lamp, centres, whitening, share):  # type: ignore[no-untyped-def]
    """Share (S, S) of the lamp's light that reaches the plane at this height past the ellipsoids, with soft borders.

    Written to `share`, whose rows and columns span the room (6,) in y and x.
    """
    size = share.shape[0]
    lamps = np.empty_like(centres)
    reach = np.empty(len(centres))  # squared distance beyond which an ellipsoid takes no light away, with its borders
    for n in range(len(centres)):
        lamps[n] = whitening[n] @ (lamp - centres[n])
        reach[n] = 1.001 * NO_SHADOW / np.min(np.sum(whitening[n] ** 2, axis=1))
    p = np.empty(3)
    for i in range(size):
        for j in range(size):
            p[0] = room[0] + (j + 0.5) / size * (room[3] - room[0])
            p[1] = room[1] + (i + 0.5) / size * (room[4] - room[1])
            p[2] = height
            left = 1.0
            for n in range(len(centres)):
                if _squared_distance(p, lamp, centres[n]) > reach[n]:
                    continue
                # Where is the line from here to the lamp nearest to the ellipsoid, and how near?
                o = whitening[n] @ (p - centres[n])
                d = lamps[n] - o
                along = min(max(-(o @ d) / (d @ d), 0.0), 1.0)
                o += along * d
                squared = o @ o
                if squared < NO_SHADOW:
                    left *= max((squared - 0.7) / 0.8, 0.0)
            share[i, j] = left


@numba.njit(cache=True)
def shade(  # type: ignore[no-untyped-def]
    K,
    T_world_camera,
    ids,
    depths,
    centres,
    whitening,
    patterns,
    numbers,
    colours,
    surfaces,
    lattice,
    light,
    room,
    shadows,
    out,
):
    """Linear light (H, W, 3) float32 that comes from what each pixel sees, written to `out`.

    Args:
        ids, depths: from `cast`.
        centres, whitening: as in `cast`.
        patterns: (N,) of PATTERNS.
        numbers: (N, 3) frequency, phase and gloss of each object.
        colours: (N, 3, 3) its three colours.
        surfaces: (6, S, S, 3) textures of the room, by -1 - id; periodic, `TEXELS` per metre.
        lattice: (NOISE_SIZE,) * 3 random numbers.
        light: (8,) position of the lamp [m], its colour, the ambient share, the distance at which it is 1 [m].
        room: as in `cast`.
        shadows: (2, S, S) from `cast_shadows`, of the floor and of the table.
    """
    height, width = ids.shape
    size, last = surfaces.shape[1], shadows.shape[1] - 1
    R = T_world_camera[:3, :3]
    eye = T_world_camera[:3, 3]
    q, p, normal, colour = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(height):
        y = (i + 0.5 - K[1, 2]) / K[1, 1]
        for j in range(width):
            x = (j + 0.5 - K[0, 2]) / K[0, 0]
            t, n = depths[i, j], ids[i, j]
            for a in range(3):
                p[a] = eye[a] + t * (R[a, 0] * x + R[a, 1] * y + R[a, 2])
                normal[a] = 0.0
            gloss = 0.0
            if n >= 0:
                for a in range(3):
                    q[a] = 0.0
                    for b in range(3):
                        q[a] += whitening[n, a, b] * (p[b] - centres[n, b])
                for a in range(3):
                    for b in range(3):
                        normal[a] += whitening[n, b, a] * q[b]
                length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
                second, third = _shares(patterns[n], q, numbers[n, 0], numbers[n, 1], lattice)
                for a in range(3):
                    normal[a] /= length
                    mixed = colours[n, 0, a] * (1.0 - second) + colours[n, 1, a] * second
                    colour[a] = mixed * (1.0 - third) + colours[n, 2, a] * third
                gloss = numbers[n, 2]
            else:
                axis = 0 if n == WALL_X else 1 if n == WALL_Y else 2
                normal[axis] = -1.0 if p[axis] > eye[axis] else 1.0
                u, v = (p[1], p[2]) if axis == 0 else (p[0], p[2]) if axis == 1 else (p[0], p[1])
                if n == TABLE_SIDE:
                    u, v = p[0] + p[1], p[2]
                row, column = int((v + 8.0) * TEXELS) % size, int((u + 8.0) * TEXELS) % size
                for a in range(3):
                    colour[a] = surfaces[-1 - n, row, column, a]
            to0, to1, to2 = light[0] - p[0], light[1] - p[1], light[2] - p[2]
            distance = math.sqrt(to0 * to0 + to1 * to1 + to2 * to2)
            cosine = max((normal[0] * to0 + normal[1] * to1 + normal[2] * to2) / distance, 0.0)
            direct = cosine * (light[7] / (distance + 0.5 * light[7])) ** 2
            if n in (TABLE, FLOOR):
                column = min(max(int((p[0] - room[0]) / (room[3] - room[0]) * last), 0), last)
                row = min(max(int((p[1] - room[1]) / (room[4] - room[1]) * last), 0), last)
                direct *= shadows[1 if n == TABLE else 0, row, column]
            shine = 0.0
            if gloss > 0.0:  # Blinn's half-way vector
                h0, h1, h2 = to0 / distance, to1 / distance, to2 / distance
                g0, g1, g2 = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
                g = math.sqrt(g0 * g0 + g1 * g1 + g2 * g2)
                h0, h1, h2 = h0 + g0 / g, h1 + g1 / g, h2 + g2 / g
                h = (normal[0] * h0 + normal[1] * h1 + normal[2] * h2) / math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
                shine = gloss * max(h, 0.0) ** 40
            ambient = light[6] * (0.75 + 0.25 * normal[2])
            for a in range(3):
                out[i, j, a] = colour[a] * (ambient + direct * light[3 + a]) + shine * light[3 + a]
