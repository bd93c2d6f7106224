"""Which poses are apart: the first of each group that nearly coincide."""

from __future__ import annotations

import numpy as np

from scanfind.kernels.jit import kernel


@kernel
def first_apart(outlines, models, apart, known, known_models, most, in_all, kept):
    """The first poses of which none moves all corners of a model's outline less than `apart` from an earlier one's.

        outlines : (H, 7, 3), models : (H,); apart : (models,) metres
        known, known_models : (K, 7, 3), (K,) poses that count as earlier ones
        most, in_all : of one model and of all; kept : (H,) out
    Returns how many of `kept` are filled.
    """
    taken = np.zeros(apart.shape[0], np.int64)
    count = 0
    for k in range(outlines.shape[0]):
        if count >= in_all:
            break
        model = models[k]
        if taken[model] >= most:
            continue
        near = False
        for j in range(known.shape[0]):
            if known_models[j] == model and coincide(outlines[k], known[j], apart[model]):
                near = True
                break
        for j in range(count):
            if near:
                break
            near = models[kept[j]] == model and coincide(outlines[k], outlines[kept[j]], apart[model])
        if not near:
            kept[count] = k
            count += 1
            taken[model] += 1
    return count


@kernel
def coincide(one, other, apart):
    """Is each corner of one outline (7, 3) less than `apart` from that of another?"""
    for c in range(one.shape[0]):
        dx, dy, dz = one[c, 0] - other[c, 0], one[c, 1] - other[c, 1], one[c, 2] - other[c, 2]
        if not dx * dx + dy * dy + dz * dz < apart * apart:
            return False
    return True
