"""The box that an ellipsoid projects to, with its derivative (document, section 2.3.3).

Seen from a camera the outline of an ellipsoid of shape S is the conic with dual C = K (S - c c^T) K^T, where c is its
centre, both in the camera frame (eq. 2.3.4). It is an ellipse exactly if the ellipsoid lies wholly in front of the
camera plane: c_z > 0 and C_33 < 0. The ellipse is kept as centre (x, y) and its own shape E, the set
(p - centre)^T E^-1 (p - centre) = 1.

A detector sees the part of the object that is inside the image. `box_of_visible_part` is therefore the box of
the ellipse *cut by the image*: an edge is the tangent of the ellipse where the tangent point is inside, the
crossing of the ellipse with the border where it is not, and the border itself where the ellipse crosses it.
An edge on the border has no derivative: it says only that the object reaches at least that far.
"""

from __future__ import annotations

import numba
import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.shape import shape_and_derivative
from calibslam_msgs_py.measurements import Array

# Columns of a Jacobian: camera rotation and translation (right perturbation, GTSAM's Pose3), then the vector (t, L).
DIMENSION = 15
POSE, QUADRIC = slice(0, 6), slice(6, 15)
UNBOUNDED = np.array([-np.inf, -np.inf, np.inf, np.inf])
ALL_EDGES = np.ones(4, np.bool_)


@numba.njit(cache=True)
def _turned(M, T, N):  # type: ignore[no-untyped-def]
    """N = R^T M R with the rotation of T."""
    for i in range(3):
        for j in range(i, 3):
            s = 0.0
            for k in range(3):
                s += T[k, i] * (M[k, 0] * T[0, j] + M[k, 1] * T[1, j] + M[k, 2] * T[2, j])
            N[i, j] = s
            N[j, i] = s


@numba.njit(cache=True)
def _outline(T_map_camera, quadric, K, outline, jacobian):  # type: ignore[no-untyped-def]
    """Outline of the ellipsoid, (x, y, E_xx, E_xy, E_yy), and its (5, 15) Jacobian; False if it has none."""
    c = np.empty(3)
    for i in range(3):
        c[i] = 0.0
        for k in range(3):
            c[i] += T_map_camera[k, i] * (quadric[k] - T_map_camera[k, 3])
    if not c[2] > 0.0:
        return False
    S = np.empty((3, 3))
    dS = np.empty((6, 3, 3))
    shape_and_derivative(quadric, S, dS)
    N = np.empty((3, 3))
    _turned(S, T_map_camera, N)
    for i in range(3):
        for j in range(3):
            N[i, j] -= c[i] * c[j]
    # K is (fx s cx; 0 fy cy; 0 0 1), so C_33 equals N_33.
    if not N[2, 2] < 0.0:
        return False
    C = _pixels(N, K)
    w = 1.0 / C[2, 2]
    x, y = C[0, 2] * w, C[1, 2] * w
    outline[0] = x
    outline[1] = y
    outline[2] = x * x - C[0, 0] * w
    outline[3] = x * y - C[0, 1] * w
    outline[4] = y * y - C[1, 1] * w
    if not (outline[2] > 0.0 and outline[4] > 0.0):  # numerically flat: edge-on or far beyond float precision
        return False
    D = np.empty((3, 3))
    e = np.empty(3)
    for column in range(DIMENSION):
        kind, axis = column // 3, column % 3
        if kind == 0:  # camera rotation: N -> E N E^T with E = Exp(-omega)
            a, b = (axis + 1) % 3, (axis + 2) % 3
            for j in range(3):
                D[axis, j] = 0.0
                D[a, j] = N[b, j]
                D[b, j] = -N[a, j]
            _add_transpose(D)
        elif kind == 1 or kind == 2:  # translation of the camera (c -> c - v) or of the quadric (c -> c + R^T v)
            for i in range(3):
                e[i] = (1.0 if i == axis else 0.0) if kind == 1 else -T_map_camera[axis, i]
            for i in range(3):
                for j in range(3):
                    D[i, j] = e[i] * c[j] + c[i] * e[j]
        else:
            _turned(dS[column - 9], T_map_camera, D)
        P = _pixels(D, K)
        dx = (P[0, 2] - x * P[2, 2]) * w
        dy = (P[1, 2] - y * P[2, 2]) * w
        jacobian[0, column] = dx
        jacobian[1, column] = dy
        jacobian[2, column] = 2.0 * x * dx - (P[0, 0] - C[0, 0] * w * P[2, 2]) * w
        jacobian[3, column] = x * dy + y * dx - (P[0, 1] - C[0, 1] * w * P[2, 2]) * w
        jacobian[4, column] = 2.0 * y * dy - (P[1, 1] - C[1, 1] * w * P[2, 2]) * w
    return True


@numba.njit(cache=True)
def _pixels(N, K):  # type: ignore[no-untyped-def]
    """K N K^T of a symmetric N, the six entries that are used (upper triangle)."""
    P = np.empty((3, 3))
    fx, s, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
    m0 = fx * N[0, 2] + s * N[1, 2] + cx * N[2, 2]
    m1 = fy * N[1, 2] + cy * N[2, 2]
    n01 = fx * N[0, 1] + s * N[1, 1] + cx * N[1, 2]
    n00 = fx * N[0, 0] + s * N[0, 1] + cx * N[0, 2]
    P[0, 0] = n00 * fx + n01 * s + m0 * cx
    P[0, 1] = n01 * fy + m0 * cy
    P[1, 1] = (fy * N[1, 1] + cy * N[1, 2]) * fy + m1 * cy
    P[0, 2] = m0
    P[1, 2] = m1
    P[2, 2] = N[2, 2]
    return P


@numba.njit(cache=True)
def _add_transpose(D):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(i, 3):
            s = D[i, j] + D[j, i]
            D[i, j] = s
            D[j, i] = s


@numba.njit(cache=True)
def _edge(outline, jacobian, axis, sign, bounds, clip, out):  # type: ignore[no-untyped-def]
    """One edge of the box of the visible part: `axis` 0 for x, 1 for y; `sign` -1 for the lower, +1 for the upper.

    Returns the edge and writes its (15,) derivative to `out`.
    """
    other = 1 - axis
    S_aa = outline[2] if axis == 0 else outline[4]
    S_bb = outline[4] if axis == 0 else outline[2]
    S_ab = outline[3]
    row_aa, row_bb = (2, 4) if axis == 0 else (4, 2)
    half = np.sqrt(S_aa)
    tangent = outline[other] + sign * S_ab / half  # where along the other axis the edge touches
    low, high = bounds[other], bounds[other + 2]
    border = min(max(tangent, low), high)
    reach = 1.0 - (border - outline[other]) ** 2 / S_bb
    if border == tangent or reach <= 0.0:  # touches inside the image; or the ellipse lies beyond that border
        edge = outline[axis] + sign * half
        for k in range(DIMENSION):
            out[k] = jacobian[axis, k] + sign * 0.5 / half * jacobian[row_aa, k]
    else:  # cut off: where the ellipse crosses the border
        gap = border - outline[other]
        slope = S_ab / S_bb
        height = S_aa - S_ab * slope
        root = np.sqrt(max(height, 0.0) * reach)
        edge = outline[axis] + slope * gap + sign * root
        scale = 0.5 * sign / root if root > 0.0 else 0.0
        for k in range(DIMENSION):
            d_gap = -jacobian[other, k]
            d_slope = (jacobian[3, k] - slope * jacobian[row_bb, k]) / S_bb
            d_height = jacobian[row_aa, k] - slope * jacobian[3, k] - S_ab * d_slope
            d_reach = (-2.0 * gap * d_gap + gap * gap / S_bb * jacobian[row_bb, k]) / S_bb
            out[k] = jacobian[axis, k] + d_slope * gap + slope * d_gap + scale * (d_height * reach + height * d_reach)
    if clip and (edge < bounds[axis] or edge > bounds[axis + 2]):
        edge = min(max(edge, bounds[axis]), bounds[axis + 2])
        out[:] = 0.0
    return edge


@numba.njit(cache=True)
def box_of_visible_part(T_map_camera, quadric, K, bounds, clip):  # type: ignore[no-untyped-def]
    """The box a perfect detector draws around an ellipsoid, and its derivative.

    Args:
        T_map_camera: (4, 4).
        quadric: (9,) centre and logarithmic shape (t, L) in the map.
        K: (3, 3) camera matrix [px], last row 0 0 1.
        bounds: (4,) xmin ymin xmax ymax of the image [px]; infinite for an image without borders.
        clip: (4,) bool, the edges that end at the border. The others go on beyond it, with their derivative:
            to compare with an edge measured inside the image, the distance still to go is what counts.

    Returns:
        visible: False if the ellipsoid does not lie wholly in front of the camera; the rest is then undefined.
        box: (4,) xmin ymin xmax ymax [px].
        jacobian: (4, 15) by the camera's pose (rotation, translation in its body) and by (t, L).
    """
    outline = np.empty(5)
    d_outline = np.empty((5, DIMENSION))
    box = np.empty(4)
    jacobian = np.empty((4, DIMENSION))
    visible = _outline(T_map_camera, quadric, K, outline, d_outline)
    if visible:
        for axis in range(2):
            box[axis] = _edge(outline, d_outline, axis, -1.0, bounds, clip[axis], jacobian[axis])
            box[axis + 2] = _edge(outline, d_outline, axis, 1.0, bounds, clip[axis + 2], jacobian[axis + 2])
    return visible, box, jacobian


def image_bounds(width: int, height: int) -> Array:
    """Bounds (4,) of an image [px], edges of its outermost pixels."""
    return np.array([0.0, 0.0, float(width), float(height)])


def project(T_camera_object: Array, radii: Array, K: Array, bounds: Array = UNBOUNDED) -> Array:
    """Boxes (N, 4) [px] of ellipsoids with poses (N, 4, 4) in the camera and radii (N, 3) [m].

    NaN where an ellipsoid does not lie wholly in front of the camera, or not in the image at all.
    """
    poses = np.asarray(T_camera_object, float).reshape(-1, 4, 4)
    boxes = np.full((len(poses), 4), np.nan)
    identity, K = np.eye(4), np.asarray(K, float)
    for i, (T, r) in enumerate(zip(poses, np.asarray(radii, float).reshape(-1, 3), strict=True)):
        visible, box, _ = box_of_visible_part(identity, Ellipsoid(T, r).vector(), K, bounds, ALL_EDGES)
        if visible and box[0] < box[2] and box[1] < box[3]:
            boxes[i] = box
    return boxes
