"""RANSAC's inner loops: draw pairs of scene points, look them up, pose each hypothesis, test it sequentially."""

from __future__ import annotations

from math import cos, floor, pi, sin, sqrt

import numpy as np

from scanfind.kernels.allowed import may_be
from scanfind.kernels.blocks import block_in, find_block, insert_block, pack_block, unpack_block
from scanfind.kernels.features import feature_key
from scanfind.kernels.grid import cube_pixel
from scanfind.kernels.jit import kernel
from scanfind.kernels.pair_pose import frame_of_pair, place_pair, pose_from_frames, refine_four_points

NORMAL_BINS = 3  # a normal's bin is one of 6 cube faces × 3 × 3, about 30° wide: 54 bits of a cell's 64-bit mask


@kernel
def random_bits(seed, stream, counter):
    """64 random bits of (seed, stream, counter): splitmix64's finaliser over a Weyl sequence.

    Counter-based, so that a draw is the same whichever thread makes it.
    """
    x = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(stream) * np.uint64(0xD1B54A32D192ED03)
    x += np.uint64(counter) * np.uint64(0x8CB92BA72F3D8DD7)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@kernel
def unit_interval(bits):
    """Uniform in [0, 1) from the upper 53 of 64 bits."""
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel
def draw_firsts(seed, stream, size, firsts):
    """Draw the first end of each of K pairs among `size` places in the pool, evenly."""
    for k in range(firsts.shape[0]):
        firsts[k] = np.int64(unit_interval(random_bits(seed, stream, 2 * k)) * size)


@kernel
def draw_seconds(
    start, stop, order, firsts, seed, stream, bin_keys, bin_of, hash_keys, hash_values, bin_starts, points, shell,
    distance, tolerance, max_tries, seconds,
):  # fmt: skip
    """Draw the second ends of pairs order[start:stop]: evenly among the places at distance ± tolerance from the first.

    order : (K,) pairs sorted by the bin of their first end; firsts : (K,) its place in the pool
    points : (W, 3) the pool, sorted by bin; bin_of : (W,) each place's bin; bin_keys : packed coordinates of the bins
    hash_keys, hash_values, bin_starts : packed bin coordinates → bin; where each bin begins in the pool
    shell : (Q, 3) from a bin to all those that may hold a point at the distance from one in it
    seconds : (K,) out, a place in the pool; -1 where there is none or max_tries tries met none

    What the bins of a shell hold is listed once for all pairs that begin in a bin; then one in twenty tries is at the
    distance. Any direction tried at random met a point in one of two hundred.
    """
    near, far = max(0.0, distance - tolerance) ** 2, (distance + tolerance) ** 2
    around = np.empty(points.shape[0], np.int32)
    found, last = 0, np.int64(-1)
    for at in range(start, stop):
        k = order[at]
        one = firsts[k]
        if bin_of[one] != last:
            last = bin_of[one]
            cx, cy, cz = unpack_block(bin_keys[last])
            found = 0
            for j in range(shell.shape[0]):
                there = find_block(
                    hash_keys, hash_values, pack_block(cx + shell[j, 0], cy + shell[j, 1], cz + shell[j, 2])
                )
                if there >= 0:
                    for place in range(bin_starts[there], bin_starts[there + 1]):
                        around[found] = place
                        found += 1
        seconds[k] = -1
        if found == 0:
            continue
        bits = random_bits(seed, stream, 2 * k + 1)
        x, y, z = points[one, 0], points[one, 1], points[one, 2]
        for _ in range(max_tries):
            bits = bits * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            two = around[np.int64(unit_interval(bits) * found)]
            dx, dy, dz = points[two, 0] - x, points[two, 1] - y, points[two, 2] - z
            if near <= dx * dx + dy * dy + dz * dz <= far:
                seconds[k] = two
                break


@kernel
def count_partners(some, points, distance, tolerance):
    """How many points (W, 3) lie at distance ± tolerance from some of them, on average."""
    near, far = max(0.0, distance - tolerance) ** 2, (distance + tolerance) ** 2
    total = 0
    for i in range(some.shape[0]):
        x, y, z = some[i, 0], some[i, 1], some[i, 2]
        for j in range(points.shape[0]):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            if near <= dx * dx + dy * dy + dz * dz <= far:
                total += 1
    return total / max(some.shape[0], 1)


@kernel
def key_pairs(first, second, signs, means, normals, edges, keys):
    """The feature cell of each of K scene pairs, -1 for a pair that is none; signs: bit 0 turns n1, bit 1 turns n2."""
    for k in range(first.shape[0]):
        keys[k] = -1
        if second[k] < 0:
            continue
        p, q = first[k], second[k]
        dx, dy, dz = means[q, 0] - means[p, 0], means[q, 1] - means[p, 1], means[q, 2] - means[p, 2]
        length = sqrt(dx * dx + dy * dy + dz * dz)
        if length <= 0.0:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        sa, sb = 1.0 - 2.0 * (signs[k] & 1), 1.0 - (signs[k] & 2)
        ax, ay, az = sa * normals[p, 0], sa * normals[p, 1], sa * normals[p, 2]
        bx, by, bz = sb * normals[q, 0], sb * normals[q, 1], sb * normals[q, 2]
        c1, c2 = ax * dx + ay * dy + az * dz, bx * dx + by * dy + bz * dz
        keys[k] = feature_key(c1, c2, ax * bx + ay * by + az * bz, edges)


@kernel
def normal_bit(x, y, z):
    """The bit of a direction in an orientation mask."""
    return np.uint64(1) << np.uint64(cube_pixel(x, y, z, np.int64(NORMAL_BINS)))


@kernel
def mark_orientations(means, normals, reach, cell, spread, signed, hash_keys, hash_values, block_keys, masks, counts):
    """Mark each surfel's normal in the cells it supports: where it is, and up to `reach` along its normal.

        spread : radians; the bins of the normal and of eight directions so far around it are set
        block_keys : (B,), masks : (B, 512) uint64, grown by the caller; counts[0] : blocks used
    Returns the surfel it stopped at because blocks ran out, else their number.
    """
    inverse = 1.0 / cell
    c, s = cos(spread), sin(spread)
    ring = np.empty((8, 2))
    for k in range(8):
        ring[k, 0], ring[k, 1] = s * cos(k * pi / 4.0), s * sin(k * pi / 4.0)
    for i in range(counts[1], means.shape[0]):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        if nx == 0.0 and ny == 0.0 and nz == 0.0:
            continue
        if counts[0] + 5 > block_keys.shape[0]:
            counts[1] = i
            return i
        # Two directions across the normal, then a ring of eight around it.
        if abs(nx) < 0.6:
            ux, uy, uz = 0.0, nz, -ny
        else:
            ux, uy, uz = -nz, 0.0, nx
        size = sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / size, uy / size, uz / size
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        mask = normal_bit(nx, ny, nz)
        for k in range(8):
            p, q = ring[k, 0], ring[k, 1]
            x, y, z = c * nx + p * ux + q * vx, c * ny + p * uy + q * vy, c * nz + p * uz + q * vz
            mask |= normal_bit(x, y, z)
            if not signed:
                mask |= normal_bit(-x, -y, -z)
        if not signed:
            mask |= normal_bit(-nx, -ny, -nz)
        for k in range(-2, 3):
            along = 0.5 * k * reach
            cx = np.int64(floor((means[i, 0] + along * nx) * inverse))
            cy = np.int64(floor((means[i, 1] + along * ny) * inverse))
            cz = np.int64(floor((means[i, 2] + along * nz) * inverse))
            key = pack_block(cx >> 3, cy >> 3, cz >> 3)
            block = find_block(hash_keys, hash_values, key)
            if block < 0:
                block = counts[0]
                counts[0] += 1
                block_keys[block] = key
                for m in range(512):
                    masks[block, m] = 0
                insert_block(hash_keys, hash_values, key, block)
            masks[block, ((cx & 7) << 6) | ((cy & 7) << 3) | (cz & 7)] |= mask
    counts[1] = means.shape[0]
    return means.shape[0]


@kernel
def lie_on_scene(
    samples, start, stop, least, most, rotation, translation, origins, inverse, where, occupied, masks, air_inverse,
    air_where, air,
):  # fmt: skip
    """How many of samples start … stop, placed, lie in cells marked with their normals' directions, in Wald's test.

        samples : (N, 6) float32 points and normals
        least : (T+1,) fewer hits after k samples end the test; no more than T are tested
        most : (T+1,) more samples in the air after k end it too
        origins : (K, 3) scanner positions: samples that face none are passed over, since they cannot tell (K > 0)
        inverse, where, occupied, masks : see grid.scene.OrientationGrid; air_inverse … air : see grid.air
    Returns hits, and how many samples were tested: -1 where the test ended it. One call for all: with as many arrays a
    call for each sample costs as much as the look-up.
    """
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    t0, t1, t2 = translation[0], translation[1], translation[2]
    hits = tested = in_air = 0
    last = least.shape[0] - 1
    for at in range(start, stop):
        px, py, pz = float(samples[at, 0]), float(samples[at, 1]), float(samples[at, 2])
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        z = r20 * px + r21 * py + r22 * pz + t2
        cx, cy = np.int64(floor(x * air_inverse)), np.int64(floor(y * air_inverse))
        cz = np.int64(floor(z * air_inverse))
        block = block_in(air_where, cx >> 3, cy >> 3, cz >> 3)
        if block >= 0 and (air[block, cx & 7] >> np.uint64(((cy & 7) << 3) | (cz & 7))) & np.uint64(1):
            tested += 1
            in_air += 1
            if hits < least[tested] or in_air > most[tested]:
                return hits, -1
            if tested == last:
                break
            continue
        nx, ny, nz = float(samples[at, 3]), float(samples[at, 4]), float(samples[at, 5])
        ux, uy, uz = r00 * nx + r01 * ny + r02 * nz, r10 * nx + r11 * ny + r12 * nz, r20 * nx + r21 * ny + r22 * nz
        facing = origins.shape[0] == 0
        for k in range(origins.shape[0]):
            if ux * (origins[k, 0] - x) + uy * (origins[k, 1] - y) + uz * (origins[k, 2] - z) > 0.0:
                facing = True
                break
        if not facing:
            continue
        tested += 1
        cx, cy, cz = np.int64(floor(x * inverse)), np.int64(floor(y * inverse)), np.int64(floor(z * inverse))
        block = block_in(where, cx >> 3, cy >> 3, cz >> 3)
        if block >= 0:
            local = ((cx & 7) << 6) | ((cy & 7) << 3) | (cz & 7)
            # Most samples of a wrong pose end here, in bits that fit the cache; the masks, 64 times as large, do not.
            marked = (occupied[block, local >> 6] >> np.uint64(local & 63)) & np.uint64(1)
            if marked and (masks[block, local] & normal_bit(ux, uy, uz)) != np.uint64(0):
                hits += 1
        if hits < least[tested]:
            return hits, -1
        if tested == last:
            break
    return hits, tested


@kernel
def fetch(points, normals, i, sign, point, normal):
    """Copy an oriented point: a view of a row would count references, which costs two threads more than the copy."""
    for c in range(3):
        point[c], normal[c] = points[i, c], sign * normals[i, c]


@kernel
def test_pairs(
    start, stop, pair_first, pair_second, pair_signs, pair_keys, means, normals,
    offsets, entry_model, entry_first, entry_second, model_starts, model_points, model_normals, samples,
    length, cell, where, occupied, masks, least_hits, most_in_air, origins, air_cell, air_where, air, allowed, sought,
):  # fmt: skip
    """Test every hypothesis of scene pairs start … stop; returns the best of each pair of each model that pass.

    Of each model: parts that are nearly alike lie on the scene as well as one another, but for noise.

    offsets, entry_* : the library's hash table in CSR form, those of a cell model by model; entry_first,
        entry_second : samples of entry_model
    model_starts : (models+1,) where each model's samples begin in model_points, model_normals
    samples : (N, 6) float32, the same points and normals side by side, for the test
    length : metres, of the normals in the four-point sets; 0 for the limit (see pair_pose)
    least_hits, most_in_air : (T+1,) Wald's tests as tables: after k points fewer hits than least_hits[k] end it, or
        more in the air than most_in_air[k]
    origins : (K, 3) scanner positions: samples that face none of them are passed over; none: all are tested
    allowed : which poses are worth a test; sought : (models,) which models are

    Returns H of them in the order of the pairs: support (H,), the share of hits among the samples tested; model (H,);
    rotation (H, 3, 3); translation (H, 3).
    """
    best_support, best_model = np.empty(64), np.empty(64, np.int64)
    best_rotation, best_translation = np.empty((64, 3, 3)), np.empty((64, 3))
    count = 0
    inverse, air_inverse = 1.0 / cell, 1.0 / air_cell
    scene, model = np.empty((4, 4)), np.empty((4, 4))
    rotation, translation = np.empty((3, 3)), np.empty(3)
    m1, a1, m2, a2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    s1, b1, s2, b2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    last = least_hits.shape[0] - 1
    for k in range(start, stop):
        so_far, best = -1, 0.0
        fetch(means, normals, pair_first[k], 1.0 - 2.0 * (pair_signs[k] & 1), s1, b1)
        fetch(means, normals, pair_second[k], 1.0 - (pair_signs[k] & 2), s2, b2)
        frame_of_pair(s1, b1, s2, b2, scene)
        for entry in range(offsets[pair_keys[k]], offsets[pair_keys[k] + 1]):
            which = entry_model[entry]
            if not sought[which]:
                continue
            base, n = model_starts[which], model_starts[which + 1] - model_starts[which]
            fetch(model_points, model_normals, base + entry_first[entry], 1.0, m1, a1)
            fetch(model_points, model_normals, base + entry_second[entry], 1.0, m2, a2)
            frame_of_pair(m1, a1, m2, a2, model)
            if not pose_from_frames(model, scene, rotation):
                continue
            if length > 0.0:
                refine_four_points(m1, a1, m2, a2, s1, b1, s2, b2, length, rotation)
            place_pair(m1, a1, m2, a2, s1, b1, s2, b2, length, rotation, translation)
            if not may_be(allowed, which, rotation, translation):
                continue
            hits, tested = lie_on_scene(
                samples, base, base + n, least_hits, most_in_air, rotation, translation, origins, inverse, where,
                occupied, masks, air_inverse, air_where, air,
            )  # fmt: skip
            if tested <= 0 or hits < least_hits[last] * tested / last:
                continue
            if which == so_far and hits / tested <= best:
                continue
            if which != so_far:
                if count == len(best_support):
                    best_support, best_model = doubled(best_support), doubled(best_model)
                    best_rotation, best_translation = doubled(best_rotation), doubled(best_translation)
                count += 1
            so_far, best = which, hits / tested
            best_support[count - 1], best_model[count - 1] = best, which
            for r in range(3):
                best_translation[count - 1, r] = translation[r]
                for c in range(3):
                    best_rotation[count - 1, r, c] = rotation[r, c]
    return best_support[:count], best_model[:count], best_rotation[:count], best_translation[:count]


@kernel
def doubled(rows):
    """The same rows with as much room again."""
    return np.concatenate((rows, np.empty_like(rows)))
