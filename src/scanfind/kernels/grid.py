"""The streaming pass: raw points → integer moments a cell and a view direction, and the nearest range a view direction.

Threads share a pass by blocks, not by points: each reads all of a chunk and adds what lies in its own blocks (its
shard), so that none writes where another does and nothing is merged afterwards.

Sums are integers (offsets in 1/65536 of a cell), so they do not depend on the order of addition: chunks, threads,
files and workers may add in any order and the result is the same to the last bit.
"""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from scanfind.kernels.blocks import BIAS, find_block, insert_block, octant_of, pack_block, unpack_block
from scanfind.kernels.jit import kernel

MOMENTS = 13  # n, Σx Σy Σz, Σxx Σxy Σxz Σyy Σyz Σzz, Σ direction to the scanner (3)
OFFSET_UNITS = 65536.0  # offsets within a cell are counted in 1/65536 of its edge: 0.3 µm in a cell of 2 cm
DIRECTION_UNITS = 1048576.0
NO_BEAM = np.int64(1 << 62)
# A beam's range is kept to 0.06 mm and its direction to a 256th of a pixel, 0.14 mm at 8 m.
RANGE_UNITS, AIM_UNITS = 16384.0, 256
FARTHEST_BEAM = 1e6
ROWS_OF_OCTANT = 64 * 54  # 64 cells, each seen in every one of the bins below
# What is counted of a shard: in use, and points that could not be addressed.
BLOCKS, OCTANTS, ROWS, LEFT_OUT = 0, 1, 2, 3
# Shards lie in the same arrays and take what they need of them by lots: large enough that two never write to one page
# often, small enough that what the last lots leave unused is little (0.4 MB of rows and 0.1 MB of the others a shard).
LOTS = (1 << 9, 1 << 8, 1 << 12)
BATCH = 256  # points whose sums stay in the first cache while their rows are looked for
VIEW_BINS = 3  # a view direction is one of 6 cube faces × 3 × 3: two in one bin are less than 35° apart


@kernel
def cube_place(x, y, z):
    """Where a direction (any length but 0) meets a cube: its face, and the place on it, each from -1 to 1."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        return (0 if x > 0 else 1), y / ax, z / ax
    if ay >= az:
        return (2 if y > 0 else 3), x / ay, z / ay
    return (4 if z > 0 else 5), x / az, y / az


@kernel
def pixel_at(face, u, v, edge):
    """The pixel of a cube map of 6 × edge × edge at a place on the cube."""
    iu = min(edge - 1, int((u + 1.0) * 0.5 * edge))
    iv = min(edge - 1, int((v + 1.0) * 0.5 * edge))
    return (face * edge + iu) * edge + iv


@kernel
def pack_beam(face, u, v, edge, distance):
    """The pixel of a beam, and in one int64 how far it went and where within the pixel: of two the nearer is less."""
    along, across = (u + 1.0) * 0.5 * edge, (v + 1.0) * 0.5 * edge
    iu, iv = min(edge - 1, int(along)), min(edge - 1, int(across))
    aim_u = min(AIM_UNITS - 1, int((along - iu) * AIM_UNITS))
    aim_v = min(AIM_UNITS - 1, int((across - iv) * AIM_UNITS))
    return (face * edge + iu) * edge + iv, (np.int64(distance * RANGE_UNITS) << 16) | (aim_u << 8) | aim_v


@kernel
def unpack_beam(pixel, packed, edge):
    """Unit direction and range of a beam, and the solid angle of its pixel."""
    face, iu, iv = pixel // (edge * edge), pixel // edge % edge, pixel % edge
    u = (iu + (((packed >> 8) & 255) + 0.5) / AIM_UNITS) * 2.0 / edge - 1.0
    v = (iv + ((packed & 255) + 0.5) / AIM_UNITS) * 2.0 / edge - 1.0
    major = 1.0 if face % 2 == 0 else -1.0
    length = sqrt(1.0 + u * u + v * v)
    major, u, v = major / length, u / length, v / length
    x, y, z = (major, u, v) if face < 2 else ((u, major, v) if face < 4 else (u, v, major))
    return x, y, z, (packed >> 16) / RANGE_UNITS, 4.0 / (edge * edge) / length**3


@kernel
def cube_pixel(x, y, z, edge):
    """The pixel of a cube map of 6 × edge × edge a direction (any length but 0) falls into."""
    face, u, v = cube_place(x, y, z)
    return pixel_at(face, u, v, edge)


@kernel
def owner_of(key, shards):
    """The shard a block belongs to: neighbours mostly to different ones, so that each has its share of any surface."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed >> np.uint64(52)) % np.uint64(shards))


@kernel
def place_of(used, lot, shard, shards):
    """Where in an array the `used`-th thing of a shard lies: the shards take lots of it in turn."""
    return ((used // lot) * shards + shard) * lot + used % lot


@kernel
def room_for(size, lot, shards):
    """How many things each shard can lay in an array of a size."""
    return size // (lot * shards) * lot


@kernel
def is_full(counts, what, more, size, shards):
    """Has a shard no room for so many more blocks, octants or rows, in arrays of that size for all shards?"""
    return counts[what] + more > room_for(size, np.int64(LOTS[what]), shards)


@kernel
def next_of(counts, what, shard, shards):
    """Where the next block, octant or row of a shard lies; there must be room."""
    place = place_of(counts[what], np.int64(LOTS[what]), shard, shards)
    counts[what] += 1
    return place


@kernel
def row_of_view(cells, links, octant, place, view):
    """The row of a cell's moments that holds a view, -1 where there is none yet. Few cells have more than three."""
    row = np.int64(cells[octant, place])
    while row >= 0 and links[row, 0] != view:
        row = np.int64(links[row, 1])
    return row


@kernel
def add_row(cells, links, moments, counts, shard, shards, octant, place, view):
    """A new, empty row for a view of a cell, first in the cell's chain; there must be room."""
    row = next_of(counts, ROWS, shard, shards)
    links[row, 0], links[row, 1] = view, cells[octant, place]
    cells[octant, place] = row
    for k in range(moments.shape[1]):
        moments[row, k] = 0
    return row


@kernel
def add_block(hash_keys, hash_values, block_keys, block_rows, counts, shard, shards, key):
    """A new block with no cell in it; there must be room."""
    block = next_of(counts, BLOCKS, shard, shards)
    block_keys[block] = key
    for k in range(8):
        block_rows.octants[block, k] = -1
    insert_block(hash_keys, hash_values, key, block)
    return block


@kernel
def add_octant(block_rows, counts, shard, shards, block, which):
    """Cells for an octant of a block, all empty; there must be room."""
    octant = next_of(counts, OCTANTS, shard, shards)
    block_rows.octants[block, which] = octant
    for k in range(64):
        block_rows.cells[octant, k] = -1
    return octant


@kernel
def octant_at(
    hash_keys, hash_values, block_keys, block_rows, moments, counts, shard, shards, key, which, more_rows
):  # fmt: skip
    """An octant of the block of a key, both there now; -1 where there is no room for these or for so many more rows."""
    if is_full(counts, ROWS, more_rows, moments.shape[0], shards):
        return np.int64(-1)
    block = find_block(hash_keys, hash_values, key)
    if block < 0:
        if is_full(counts, BLOCKS, 1, block_keys.shape[0], shards):
            return np.int64(-1)
        block = add_block(hash_keys, hash_values, block_keys, block_rows, counts, shard, shards, key)
    octant = np.int64(block_rows.octants[block, which])
    if octant < 0:
        if is_full(counts, OCTANTS, 1, block_rows.cells.shape[0], shards):
            return np.int64(-1)
        octant = add_octant(block_rows, counts, shard, shards, block, which)
    return octant


@kernel
def add_child(parents, p, children, c, ex, ey, ez):
    """Add a child's row of moments, about a centre at offset e, to its parent's row."""
    n, sx, sy, sz = children[c, 0], children[c, 1], children[c, 2], children[c, 3]
    parents[p, 0] += n
    parents[p, 1] += sx + n * ex
    parents[p, 2] += sy + n * ey
    parents[p, 3] += sz + n * ez
    parents[p, 4] += children[c, 4] + 2 * ex * sx + n * ex * ex
    parents[p, 5] += children[c, 5] + ex * sy + ey * sx + n * ex * ey
    parents[p, 6] += children[c, 6] + ex * sz + ez * sx + n * ex * ez
    parents[p, 7] += children[c, 7] + 2 * ey * sy + n * ey * ey
    parents[p, 8] += children[c, 8] + ey * sz + ez * sy + n * ey * ez
    parents[p, 9] += children[c, 9] + 2 * ez * sz + n * ez * ez
    for k in range(10, 13):
        parents[p, k] += children[c, k]


@kernel
def accumulate(
    points, start, origin, has_origin, offset, cell, shard, shards,
    hash_keys, hash_values, block_keys, block_rows, moments, links, counts, nearest, edge,
):  # fmt: skip
    """Add those of points[start:] that lie in a shard's blocks; returns how far it came: len(points), or less where an
    array is full.

    offset : (3,) the grid's own origin, the points' frame
    hash_keys, hash_values : of the shard's blocks; open addressing, power of two
    block_keys : (B,) packed; block_rows : BlockRows, where in these each cell's moments are
    moments : (R, 13) one row for each cell and view; links : (R, 2) the row's view, and the cell's next row or -1
    counts : the shard's blocks, octants and rows in use, and points too far away to be addressed (told by shard 0)
    nearest : (6·edge²,) the nearest beam the shard knows of in each pixel about the scanner (pack_beam), or NO_BEAM

    Points come along scan lines: most lie in the cell of the one before, and are summed with it before their row is
    looked for. Rows lie all over the memory: those of a batch are looked for together, one step after the other and
    not one row after the other, so that no step waits for the memory of the step before.
    """
    sums = np.empty((BATCH, moments.shape[1]), np.int64)
    places, views = np.empty(BATCH, np.int64), np.empty(BATCH, np.int64)
    heads, seen = np.empty(BATCH, np.int64), np.empty(BATCH, np.int64)
    cells = block_rows.cells
    for first in range(start, points.shape[0], BATCH):
        if (
            is_full(counts, BLOCKS, BATCH, block_keys.shape[0], shards)
            or is_full(counts, OCTANTS, BATCH, cells.shape[0], shards)
            or is_full(counts, ROWS, BATCH, moments.shape[0], shards)
        ):
            return first
        runs = sum_runs(
            points[first : first + BATCH], origin, has_origin, offset, cell, shard, shards,
            hash_keys, hash_values, block_keys, block_rows, counts, nearest, edge, places, views, sums,
        )  # fmt: skip
        for k in range(runs):
            heads[k] = cells[places[k] >> 6, places[k] & 63]
        for k in range(runs):
            seen[k] = links[max(heads[k], 0), 0]
        for k in range(runs):
            if heads[k] >= 0 and seen[k] == views[k]:
                continue
            octant, place = places[k] >> 6, places[k] & 63
            heads[k] = row_of_view(cells, links, octant, place, views[k])
            if heads[k] < 0:
                heads[k] = add_row(cells, links, moments, counts, shard, shards, octant, place, views[k])
        for k in range(runs):
            for j in range(moments.shape[1]):
                moments[heads[k], j] += sums[k, j]
    return points.shape[0]


@kernel
def sum_runs(
    points, origin, has_origin, offset, cell, shard, shards,
    hash_keys, hash_values, block_keys, block_rows, counts, nearest, edge, places, views, sums,
):  # fmt: skip
    """The moments of each run of points (N, 3), among a shard's own, that lie in one cell and were seen from one side,
    and note their beams; returns how many runs there are. The rest: see accumulate.

    places, views, sums : (N or more,) out: 64 times a cell's octant and its place in that; the view; the moments
    """
    inverse = 1.0 / cell
    last_key, last_block = np.int64(-1), np.int64(-1)
    mine, view = True, np.int64(0)
    last_local, last_view, run = np.int64(-1), np.int64(-1), np.int64(-1)
    dx = dy = dz = distance = 0.0
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        gx, gy, gz = (px - offset[0]) * inverse, (py - offset[1]) * inverse, (pz - offset[2]) * inverse
        # Before floor, which makes an int64 of it: the 1e38 some exporters write for "no data" would wrap round.
        if not (abs(gx) < 8 * (BIAS - 2) and abs(gy) < 8 * (BIAS - 2) and abs(gz) < 8 * (BIAS - 2)):
            counts[LEFT_OUT] += shard == 0
            continue
        fx, fy, fz = floor(gx), floor(gy), floor(gz)
        cx, cy, cz = np.int64(fx), np.int64(fy), np.int64(fz)
        key = pack_block(cx >> 3, cy >> 3, cz >> 3)
        if key != last_key:
            last_key, last_local = key, np.int64(-1)
            mine = owner_of(key, shards) == shard
            if mine:
                last_block = find_block(hash_keys, hash_values, key)
                if last_block < 0:
                    last_block = add_block(hash_keys, hash_values, block_keys, block_rows, counts, shard, shards, key)
        if not mine:
            continue
        if has_origin:
            dx, dy, dz = px - origin[0], py - origin[1], pz - origin[2]
            distance = sqrt(dx * dx + dy * dy + dz * dz)
            view = np.int64(0)
            if distance > 0.0:
                face, u, v = cube_place(dx, dy, dz)
                view = pixel_at(face, u, v, VIEW_BINS)
                pixel, beam = pack_beam(face, u, v, edge, distance)
                nearest[pixel] = min(nearest[pixel], beam)
        local = ((cx & 7) << 6) | ((cy & 7) << 3) | (cz & 7)
        if local != last_local or view != last_view:
            last_local, last_view = local, view
            which, place = octant_of(local)
            octant = np.int64(block_rows.octants[last_block, which])
            if octant < 0:
                octant = add_octant(block_rows, counts, shard, shards, last_block, which)
            run += 1
            places[run], views[run] = (octant << 6) | place, view
            for k in range(sums.shape[1]):
                sums[run, k] = 0
        ox = np.int64(floor((gx - fx - 0.5) * OFFSET_UNITS + 0.5))
        oy = np.int64(floor((gy - fy - 0.5) * OFFSET_UNITS + 0.5))
        oz = np.int64(floor((gz - fz - 0.5) * OFFSET_UNITS + 0.5))
        sums[run, 0] += 1
        sums[run, 1] += ox
        sums[run, 2] += oy
        sums[run, 3] += oz
        sums[run, 4] += ox * ox
        sums[run, 5] += ox * oy
        sums[run, 6] += ox * oz
        sums[run, 7] += oy * oy
        sums[run, 8] += oy * oz
        sums[run, 9] += oz * oz
        if has_origin and distance > 0.0:
            scale = DIRECTION_UNITS / distance
            sums[run, 10] -= np.int64(dx * scale)
            sums[run, 11] -= np.int64(dy * scale)
            sums[run, 12] -= np.int64(dz * scale)
    return run + 1


@kernel
def note_beams(points, origin, nearest, edge):
    """Note the beams from a scanner at `origin` (3,) to points (N, 3); nearest : see accumulate."""
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        distance = sqrt(dx * dx + dy * dy + dz * dz)
        # What is farther than any instrument reaches (1e38 for "no data") would not fit its place.
        if 0.0 < distance < FARTHEST_BEAM:
            face, u, v = cube_place(dx, dy, dz)
            pixel, beam = pack_beam(face, u, v, edge, distance)
            nearest[pixel] = min(nearest[pixel], beam)


@kernel
def sum_children(
    start, children, child_keys, child_rows, child_moments, child_links, half, shard, shards,
    hash_keys, hash_values, block_keys, block_rows, moments, links, counts,
):  # fmt: skip
    """Sum cells into those of a shard's blocks, of twice the edge; returns how far it came (see accumulate).

    children : where the child blocks lie, of which those from `start` on are summed
    half : half a child's edge in offset units: a child's centre lies so far from its parent's, along each axis
    """
    for at in range(start, children.shape[0]):
        child = children[at]
        bx, by, bz = unpack_block(child_keys[child])
        key = pack_block(bx >> 1, by >> 1, bz >> 1)
        if owner_of(key, shards) != shard:
            continue
        # A child block fills one octant of its parent: 64 new cells with all their views at most.
        which = ((bx & 1) << 2) | ((by & 1) << 1) | (bz & 1)
        octant = octant_at(
            hash_keys, hash_values, block_keys, block_rows, moments, counts, shard, shards, key, which, ROWS_OF_OCTANT
        )  # fmt: skip
        if octant < 0:
            return at
        for eighth in range(8):
            from_octant = np.int64(child_rows.octants[child, eighth])
            if from_octant < 0:
                continue
            for local in range(64):
                child_row = np.int64(child_rows.cells[from_octant, local])
                if child_row < 0:
                    continue
                # Of the three bits of a place along an axis the first is the octant's, the last says which half.
                px = ((eighth >> 2) << 1) | (local >> 5)
                py = (((eighth >> 1) & 1) << 1) | ((local >> 3) & 1)
                pz = ((eighth & 1) << 1) | ((local >> 1) & 1)
                place = (px << 4) | (py << 2) | pz
                ex = half if local & 16 else -half
                ey = half if local & 4 else -half
                ez = half if local & 1 else -half
                while child_row >= 0:
                    view = np.int64(child_links[child_row, 0])
                    row = row_of_view(block_rows.cells, links, octant, place, view)
                    if row < 0:
                        row = add_row(block_rows.cells, links, moments, counts, shard, shards, octant, place, view)
                    add_child(moments, row, child_moments, child_row, ex, ey, ez)
                    child_row = np.int64(child_links[child_row, 1])
    return children.shape[0]


@kernel
def add_rows(
    start, keys, places, views, sums, shard, shards,
    hash_keys, hash_values, block_keys, block_rows, moments, links, counts,
):  # fmt: skip
    """Add rows[start:] of another grid with these cells to a shard's blocks; returns how far it came (see accumulate).

    keys, places, views : (R,) the block, cell and view of each row; sums : (R, 13) its moments
    """
    for i in range(start, keys.shape[0]):
        key = keys[i]
        if owner_of(key, shards) != shard:
            continue
        which, place = octant_of(np.int64(places[i]))
        # Before anything is added: a row that is begun again must not count twice.
        octant = octant_at(
            hash_keys, hash_values, block_keys, block_rows, moments, counts, shard, shards, key, which, 1
        )  # fmt: skip
        if octant < 0:
            return i
        view = np.int64(views[i])
        row = row_of_view(block_rows.cells, links, octant, place, view)
        if row < 0:
            row = add_row(block_rows.cells, links, moments, counts, shard, shards, octant, place, view)
        for k in range(moments.shape[1]):
            moments[row, k] += sums[i, k]
    return keys.shape[0]
