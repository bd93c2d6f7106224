"""Nearest surface: a tree of boxes over triangles or samples, exact distances, and which raw points need one.

Sources: nearest point of a triangle by its Voronoi regions, Ericson, "Real-Time Collision Detection" (2005), 5.1.5;
sign at edges and corners, Bærentzen & Aanæs, "Signed distance computation using the angle weighted
pseudonormal" (2005).
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanfind.kernels.jit import kernel

LEAF = 4  # primitives a leaf at most
STACK = 64  # a depth-first descent holds at most one open node a level: enough for 2^64 primitives
SLACK = 1.0 + 1e-9  # for the rounding of two formulas for one squared distance: a tie must be opened, never lost

# The parts of a triangle the nearest point may lie on.
FACE, EDGE, CORNER = 0, 1, 4  # FACE; EDGE + 0, 1, 2: ab, bc, ca; CORNER + 0, 1, 2: a, b, c


class NearSurface(NamedTuple):
    """A surface that can be asked how far points are, and on which side; built by `scanfind.library.near_surface`.

    A tree of boxes, not voxels with lists: it costs 200 bytes a triangle whatever the reach, where lists for triangles
    of 3 mm and a reach of 1 cm would hold 400 entries a voxel.

    corners : (F, 3, 3) model frame, metres, in the order of the tree; a sample is three times the same point
    normals : (F, 3) unit, outwards; zero for a needle, which is measured as its edges
    pseudonormals : (F, 6, 3) towards outside at edges ab, bc, ca and corners a, b, c; (0, 6, 3) for samples
    face : (F,) the caller's number of each
    boxes : (2 L, 6) low and high corner of node k, whose children are 2 k and 2 k + 1; 1 is the root, L … 2 L - 1 are
        leaves, and leaf j has primitives F j // L … F (j + 1) // L; row 0 is unused
    reach : farther than this, metres, nobody asks
    spacing : distance of neighbouring samples, metres; 0 for triangles
    signed : False where nobody knows which side is outside
    """

    corners: NDArray[np.float64]
    normals: NDArray[np.float64]
    pseudonormals: NDArray[np.float32]
    face: NDArray[np.int32]
    boxes: NDArray[np.float64]
    reach: float
    spacing: float
    signed: bool


class Vicinity(NamedTuple):
    """The cells of the scene near any placed surface: most raw points are in none and need no distance.

    low : (3,) corner of the first block, shifted scene, metres
    cell : edge of a cell, metres; a block has 8 × 8 × 8
    top : (X, Y, Z) number of each block, -1 where no surface is near
    bits : (B, 8) a byte of 64 bits for each x in a block: bit 8 y + z
    """

    low: NDArray[np.float64]
    cell: float
    top: NDArray[np.int32]
    bits: NDArray[np.uint64]


@kernel
def box_order(centres, leaves, order):
    """Reorder the numbers `order` (F,) of F centres (F, 3): every node of the tree halves its part along the longest
    side.
    """
    n = len(centres)
    level = 1
    while level < leaves:
        for k in range(level):
            start, middle, stop = n * k // level, n * (2 * k + 1) // (2 * level), n * (k + 1) // level
            axis, longest = 0, -1.0
            for candidate in range(3):
                low, high = np.inf, -np.inf
                for i in range(start, stop):
                    value = centres[order[i], candidate]
                    low, high = min(low, value), max(high, value)
                if high - low > longest:
                    axis, longest = candidate, high - low
            split_at(order, centres[:, axis], start, middle, stop)
        level *= 2


@kernel
def split_at(order, values, start, middle, stop):
    """Reorder order[start:stop] so that no value before `middle` is above any from there on (Hoare's selection)."""
    low, high = start, stop - 1
    while low < high:
        pivot = values[order[(low + high) // 2]]
        i, j = low, high
        while i <= j:
            while values[order[i]] < pivot:
                i += 1
            while values[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@njit(inline="always")
def outside(low, value, high):
    """How far a value is outside an interval."""
    return low - value if value < low else (value - high if value > high else 0.0)


@njit(inline="always")
def to_box(boxes, node, x, y, z):
    """Squared distance to a box; 0 inside."""
    dx = outside(boxes[node, 0], x, boxes[node, 3])
    dy = outside(boxes[node, 1], y, boxes[node, 4])
    dz = outside(boxes[node, 2], z, boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@njit(inline="always")
def corner_of(corners, f, k):
    """Corner k of face f, three scalars."""
    return corners[f, k, 0], corners[f, k, 1], corners[f, k, 2]


@kernel
def side(ex, ey, ez, px, py, pz, nx, ny, nz):
    """Negative where p is on the outer side of edge e of a triangle with normal n, both from the edge's beginning."""
    return nx * (ey * pz - ez * py) + ny * (ez * px - ex * pz) + nz * (ex * py - ey * px)


@kernel
def from_edge(ax, ay, az, bx, by, bz, x, y, z):
    """From the nearest point of edge a → b to the point: dx, dy, dz, and the end it lies on: 1 a, 2 b, 0 between.

    Always measured from the end that comes first, so that the two triangles of an edge get the same bits and tie.
    """
    swap = bx < ax or (bx == ax and (by < ay or (by == ay and bz < az)))
    if swap:
        ax, ay, az, bx, by, bz = bx, by, bz, ax, ay, az
    ex, ey, ez = bx - ax, by - ay, bz - az
    px, py, pz = x - ax, y - ay, z - az
    along, whole = ex * px + ey * py + ez * pz, ex * ex + ey * ey + ez * ez
    if along <= 0.0:
        return px, py, pz, 2 if swap else 1
    if along >= whole:
        return x - bx, y - by, z - bz, 1 if swap else 2
    t = along / whole
    return px - t * ex, py - t * ey, pz - t * ez, 0


@kernel
def to_triangle(corners, normals, f, x, y, z, limit):
    """Squared distance to a triangle, and the part the nearest point lies on; infinite beyond the squared limit.

    Inside or not is asked of the normal, not of barycentric coordinates: those are products of four lengths, and in a
    triangle a millionth as high as long nothing is left of them.
    """
    ax, ay, az = corner_of(corners, f, 0)
    nx, ny, nz = normals[f, 0], normals[f, 1], normals[f, 2]
    plane = nx * (x - ax) + ny * (y - ay) + nz * (z - az)
    if plane * plane > limit:
        return np.inf, FACE
    bx, by, bz = corner_of(corners, f, 1)
    cx, cy, cz = corner_of(corners, f, 2)
    needle = nx == 0.0 and ny == 0.0 and nz == 0.0
    beyond_ab = needle or side(bx - ax, by - ay, bz - az, x - ax, y - ay, z - az, nx, ny, nz) < 0.0
    beyond_bc = needle or side(cx - bx, cy - by, cz - bz, x - bx, y - by, z - bz, nx, ny, nz) < 0.0
    beyond_ca = needle or side(ax - cx, ay - cy, az - cz, x - cx, y - cy, z - cz, nx, ny, nz) < 0.0
    if not (beyond_ab or beyond_bc or beyond_ca):
        return plane * plane, FACE
    best, part = np.inf, FACE
    if beyond_ab:
        dx, dy, dz, end = from_edge(ax, ay, az, bx, by, bz, x, y, z)
        best = dx * dx + dy * dy + dz * dz
        part = EDGE if end == 0 else (CORNER if end == 1 else CORNER + 1)
    if beyond_bc:
        dx, dy, dz, end = from_edge(bx, by, bz, cx, cy, cz, x, y, z)
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < best:
            best, part = d2, EDGE + 1 if end == 0 else (CORNER + 1 if end == 1 else CORNER + 2)
    if beyond_ca:
        dx, dy, dz, end = from_edge(cx, cy, cz, ax, ay, az, x, y, z)
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < best:
            best, part = d2, EDGE + 2 if end == 0 else (CORNER + 2 if end == 1 else CORNER)
    return best, part


@kernel
def nearest(near, x, y, z, limit, enough, nodes, bounds):
    """The nearest primitive within `limit`: squared distance, row or -1, part; the lowest face of a tie.

    enough : the first one of this squared distance or less will do
    nodes, bounds : (STACK,) room for the nodes still to be opened and their squared distances
    """
    leaves, n = len(near.boxes) // 2, len(near.corners)
    best, row, part = limit * limit, -1, FACE
    nodes[0], bounds[0], waiting = 1, to_box(near.boxes, 1, x, y, z), 1
    while waiting > 0:
        waiting -= 1
        node = nodes[waiting]
        if bounds[waiting] > best * SLACK:
            continue
        while node < leaves:
            node, other = 2 * node, 2 * node + 1
            bound, other_bound = to_box(near.boxes, node, x, y, z), to_box(near.boxes, other, x, y, z)
            if other_bound < bound:
                node, other = other, node
                bound, other_bound = other_bound, bound
            if other_bound <= best * SLACK:
                nodes[waiting], bounds[waiting] = other, other_bound
                waiting += 1
            if bound > best * SLACK:
                break
        if node < leaves:
            continue
        j = node - leaves
        for f in range(n * j // leaves, n * (j + 1) // leaves):
            if near.spacing > 0.0:
                px, py, pz = corner_of(near.corners, f, 0)
                d2, where = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2, FACE
            else:
                d2, where = to_triangle(near.corners, near.normals, f, x, y, z, best * SLACK)
            if d2 < best or (d2 == best and (row < 0 or near.face[f] < near.face[row])):
                best, row, part = d2, f, where
        if row >= 0 and best <= enough:
            break
    return best, row, part


@kernel
def signed_distance(near, row, part, squared, x, y, z):
    """Distance of a point to the primitive `nearest` found, + outside; NaN where it is out of reach after all."""
    ax, ay, az = corner_of(near.corners, row, 0)
    plane = near.normals[row, 0] * (x - ax) + near.normals[row, 1] * (y - ay) + near.normals[row, 2] * (z - az)
    if near.spacing > 0.0:
        # A sample stands for a small disk: beyond its rim there is no surface to measure.
        if squared - plane * plane > near.spacing * near.spacing or abs(plane) > near.reach:
            return np.nan
        return plane if near.signed else abs(plane)
    distance = sqrt(squared)
    if not near.signed:
        return distance
    if part == FACE:
        return plane
    k = (part - EDGE) % 3
    ax, ay, az = corner_of(near.corners, row, k)
    if part >= CORNER:
        dx, dy, dz = x - ax, y - ay, z - az
    else:
        bx, by, bz = corner_of(near.corners, row, (k + 1) % 3)
        dx, dy, dz, _ = from_edge(ax, ay, az, bx, by, bz, x, y, z)
    m = near.pseudonormals
    cosine = m[row, part - EDGE, 0] * dx + m[row, part - EDGE, 1] * dy + m[row, part - EDGE, 2] * dz
    return distance if cosine >= 0.0 else -distance


@kernel
def to_model(rotation, translation, u, v, w):
    """A point of the shifted scene in the frame of the model placed there by rotation (3, 3) and translation (3,)."""
    u, v, w = u - translation[0], v - translation[1], w - translation[2]
    x = rotation[0, 0] * u + rotation[1, 0] * v + rotation[2, 0] * w
    y = rotation[0, 1] * u + rotation[1, 1] * v + rotation[2, 1] * w
    z = rotation[0, 2] * u + rotation[1, 2] * v + rotation[2, 2] * w
    return x, y, z


@kernel
def distances(near, rotation, translation, shift, xyz, rows):
    """Signed distances (K,) float32 of the points xyz[rows], NaN beyond reach, and the nearest faces (K,), -1 there.

    rotation, translation : (3, 3), (3,) scene_from_model, where the scene is xyz - shift
    """
    distance, face = np.empty(len(rows), np.float32), np.empty(len(rows), np.int32)
    nodes, bounds = np.empty(STACK, np.int64), np.empty(STACK)
    limit = sqrt(near.reach**2 + near.spacing**2)
    for i in range(len(rows)):
        # In double precision, far coordinates first: at 5,000 km from the origin a digit is a nanometre.
        u, v, w = xyz[rows[i], 0] - shift[0], xyz[rows[i], 1] - shift[1], xyz[rows[i], 2] - shift[2]
        x, y, z = to_model(rotation, translation, u, v, w)
        squared, row, part = nearest(near, x, y, z, limit, -1.0, nodes, bounds)
        distance[i], face[i] = np.nan, -1
        if row >= 0:
            distance[i] = signed_distance(near, row, part, squared, x, y, z)
            if distance[i] == distance[i]:
                face[i] = near.face[row]
    return distance, face


@kernel
def mark_cells(near, rotation, translation, x0, y0, z0, cell, allowed, nodes, bounds, block, bits):
    """Set the bits bits[block] of the cells within `allowed` of a placed surface, in the block with this low corner."""
    m = 0  # cells in Morton order: a half or quarter of the block that is far from the surface is skipped whole
    while m < 512:
        i = (m & 1) | (m >> 2 & 2) | (m >> 4 & 4)
        j = (m >> 1 & 1) | (m >> 3 & 2) | (m >> 5 & 4)
        k = (m >> 2 & 1) | (m >> 4 & 2) | (m >> 6 & 4)
        size = 8 if m == 0 else (4 if m % 64 == 0 else (2 if m % 8 == 0 else 1))
        while size > 0:
            half = 0.5 * size * cell
            u, v, w = x0 + i * cell + half, y0 + j * cell + half, z0 + k * cell + half
            x, y, z = to_model(rotation, translation, u, v, w)
            # Half the diagonal, and a millionth more for the rounding of cell addresses.
            limit = allowed + sqrt(3.0) * half * (1.0 + 1e-6)
            _, row, _ = nearest(near, x, y, z, limit, limit * limit, nodes, bounds)
            if row < 0:
                break
            size //= 2
        if size == 0:
            bits[block, i] |= np.uint64(1) << np.uint64(8 * j + k)
            m += 1
        else:
            m += size * size * size


@kernel
def cells_near(near, rotation, translation, low, cell, blocks, tolerance, bits):
    """Set the bits (B, 8) of the cells within `tolerance` of a placed surface, in the blocks at coordinates (B, 3)."""
    nodes, bounds = np.empty(STACK, np.int64), np.empty(STACK)
    edge, allowed = 8.0 * cell, sqrt(tolerance**2 + near.spacing**2)
    for b in range(len(blocks)):
        x, y, z = low[0] + edge * blocks[b, 0], low[1] + edge * blocks[b, 1], low[2] + edge * blocks[b, 2]
        mark_cells(near, rotation, translation, x, y, z, cell, allowed, nodes, bounds, b, bits)


@kernel
def blocks_of(vicinity, shift, xyz):
    """The block of each of N points whose cell is near a placed surface, (N,) int32; -1 for the many that are not."""
    n = len(xyz)
    block = np.empty(n, np.int32)
    top, bits = vicinity.top, vicinity.bits
    per_cell = 1.0 / vicinity.cell
    size_x, size_y, size_z = 8.0 * top.shape[0], 8.0 * top.shape[1], 8.0 * top.shape[2]
    for i in range(n):
        found = -1
        x = ((xyz[i, 0] - shift[0]) - vicinity.low[0]) * per_cell
        y = ((xyz[i, 1] - shift[1]) - vicinity.low[1]) * per_cell
        z = ((xyz[i, 2] - shift[2]) - vicinity.low[2]) * per_cell
        if 0.0 <= x < size_x and 0.0 <= y < size_y and 0.0 <= z < size_z:
            ix, iy, iz = int(x), int(y), int(z)
            b = top[ix >> 3, iy >> 3, iz >> 3]
            if b >= 0 and bits[b, ix & 7] >> np.uint64(8 * (iy & 7) + (iz & 7)) & np.uint64(1):
                found = b
        block[i] = found
    return block
