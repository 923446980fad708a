"""The list of one tile by depth: while it is in the cache, and on whichever thread draws it."""

import numpy as np

from asysplat.ops.cpu.kernel import inline
from asysplat.rendering.cpu import layout as col

SHORT = 32  # lists up to this are sorted by insertion
RADIX = 256
DIGITS = 4


@inline
def sort_by_depth(entries, start, stop, splats, keys, scratch, counts):
    """Sort entries[start:stop] by depth to all of its digits, then by Gaussian; stable.

    Args:
        splats: depths; all are positive, so their bits order as they do.
        keys, scratch: [2, m] and [2, m, 2], m >= stop - start.
        counts: [DIGITS, RADIX].
    """
    length = stop - start
    if length > SHORT:
        _radix_sort(entries, start, length, splats, keys, scratch, counts)
    # Ties of float32 are short runs, broken by what it left of the depths; short lists are one run.
    for i in range(start + 1, stop):
        d, pair = entries[i, 0], entries[i, 1]
        depth, rest = splats[d, col.DEPTH], splats[d, col.DEPTH_REST]
        j = i - 1
        while j >= start:
            other = entries[j, 0]
            if splats[other, col.DEPTH] < depth:
                break
            if splats[other, col.DEPTH] == depth and splats[other, col.DEPTH_REST] <= rest:
                break
            entries[j + 1, 0], entries[j + 1, 1] = other, entries[j, 1]
            j -= 1
        entries[j + 1, 0], entries[j + 1, 1] = d, pair


@inline
def _radix_sort(entries, start, length, splats, keys, scratch, counts):
    bits = splats.view(np.uint32)
    counts[:] = 0
    for i in range(length):
        key = bits[entries[start + i, 0], col.DEPTH]
        keys[0, i] = key
        scratch[0, i, 0], scratch[0, i, 1] = entries[start + i, 0], entries[start + i, 1]
        for digit in range(DIGITS):
            counts[digit, (key >> np.uint32(8 * digit)) & np.uint32(RADIX - 1)] += 1
    now = 0
    for digit in range(DIGITS):
        shift = np.uint32(8 * digit)
        if counts[digit, (keys[now, 0] >> shift) & np.uint32(RADIX - 1)] == length:
            continue  # all have the same digit
        position = 0
        for value in range(RADIX):
            count = counts[digit, value]
            counts[digit, value] = position
            position += count
        for i in range(length):
            key = keys[now, i]
            value = (key >> shift) & np.uint32(RADIX - 1)
            position = counts[digit, value]
            counts[digit, value] = position + 1
            keys[1 - now, position] = key
            scratch[1 - now, position, 0] = scratch[now, i, 0]
            scratch[1 - now, position, 1] = scratch[now, i, 1]
        now = 1 - now
    for i in range(length):
        entries[start + i, 0], entries[start + i, 1] = scratch[now, i, 0], scratch[now, i, 1]
