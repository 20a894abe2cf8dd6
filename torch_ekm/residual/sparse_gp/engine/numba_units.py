"""The units of columns as compiled loops: pooled from a block, adopted; see :class:`RunningScale`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from ...running_scale import ALIEN, BLOCK, BURST_CLIP, CLIP, COMPANY, DOUBT, REST, SPIKES, TRIMMED
from .numba_memory import A1, A2, COMMON, EPS, INT, TINY, F, inner, matrix_at, vector_at


@inner(F(A1, F))
def _trimmed(squares, part):
    """Root of the mean of n squares in order without the last n/part."""
    kept, total = max(squares.shape[0] - math.ceil(squares.shape[0] / part), 0), 0.0
    for i in range(kept):
        total += squares[i]
    return math.sqrt(total / max(kept, 1))


@njit(types.void(INT, INT, INT, INT, INT, F, INT, INT, INT, INT, INT, INT, INT), **COMMON)
def pool_columns(models, first, n, kept, columns, memory, of, on, shifted, weights, centres, spreads, large):
    """The pooled figures of each model's columns take n samples in; all given by addresses.

    ``of``, ``on``: ring of the last ``kept`` samples ``(kept, columns)``; the first one has number ``first``.
    """
    x, away, values, here = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for column in range(models * columns):
        b, c = column // columns, column % columns
        counts, shift, size = vector_at(large, column, 2), vector_at(shifted, 0, columns)[c], 0
        for i in range(n):
            place = (first + i) % kept
            values[i], here[i] = matrix_at(of, b, kept, columns)[place, c], vector_at(on, b, kept)[place]
            if here[i] > 0.0:
                x[size] = values[i]
                size += 1
        order, count, most = np.sort(x[:size]), float(size), TINY
        middle = order[(size - 1) // 2] if shift * count > 0 else 0.0
        for i in range(n):
            away[i] = values[i] - middle if here[i] > 0.0 else 0.0
            most = max(most, abs(away[i]))
        for i in range(n):
            away[i] /= most
        for i in range(size):
            order[i] = ((x[i] - middle) / most) ** 2
        order.sort()
        few, many = _trimmed(order, TRIMMED[0]), _trimmed(order, TRIMMED[1])
        typical = many if many > SPIKES * few else few
        bound, fade = CLIP * typical if typical > 0.0 else 1.0, 1.0 - BLOCK / memory
        counts[0], counts[1] = counts[0] * fade, counts[1] * fade
        for i in range(n):
            if abs(away[i]) > bound:
                near = (i > 0 and abs(away[i - 1]) > bound) or (i < n - 1 and abs(away[i + 1]) > bound)
                counts[0], counts[1] = counts[0] + 1.0, counts[1] + (0.0 if near else 1.0)
        at = vector_at(weights, column, 1), vector_at(centres, column, 1), vector_at(spreads, column, 1)
        weight, centre, spread = at
        share = counts[0] / max(min(weight[0], memory) + count, 1.0)
        if counts[1] + DOUBT < COMPANY * (1.0 - min(share, 1.0)) ** 2 * (counts[0] + DOUBT):
            bound *= BURST_CLIP
        mean, square = 0.0, 0.0
        for i in range(n):
            away[i] = min(max(away[i], -bound), bound)
            mean += away[i]
        mean = mean / max(count, 1.0) * shift
        for i in range(n):
            square += (away[i] - mean) ** 2 if here[i] > 0.0 else 0.0
        new, gap = most * math.sqrt(square / max(count, 1.0)), middle + most * mean - centre[0]
        past = spread[0] if new == 0.0 or new > ALIEN * spread[0] else 0.0
        count *= REST[1] if new < REST[0] * past else 1.0
        before = min(weight[0], memory) if past == spread[0] else 0.0
        if before == 0.0:
            centre[0], gap = middle + most * mean, 0.0
        weight[0] = before + count
        part, largest = count / max(weight[0], TINY), max(abs(gap), past, new, TINY)
        inside = (1.0 - part) * math.sqrt(past / largest) + part * math.sqrt(new / largest)
        spread[0] = largest * math.sqrt(inside**4 + (1.0 - part) * part * (gap / largest) ** 2)
        centre[0] += part * gap


@njit(types.boolean(INT, INT, F, A2, INT, INT, INT, INT, INT, INT), **COMMON)
def settle_columns(models, columns, settled, change, weights, centres, spreads, least, scales, shifts):
    """New scales and shifts, the change into ``change``: offset and ratio; returns whether there is one."""
    least_of, any_ = vector_at(least, 0, columns), False
    for column in range(models * columns):
        centre, spread = vector_at(centres, column, 1)[0], vector_at(spreads, column, 1)[0]
        scale_of, shift_of = vector_at(scales, column, 1), vector_at(shifts, column, 1)
        scale, shift, lowest = scale_of[0], shift_of[0], least_of[column % columns]
        new = lowest if lowest > 0.0 else 1.0
        if spread > 100.0 * EPS * abs(centre) and spread > TINY:
            new = max(spread, lowest)
        off = max(new / scale, scale / new) - 1.0 + abs(centre - shift) / min(new, scale)
        change[0, column], change[1, column] = 0.0, 1.0
        if vector_at(weights, column, 1)[0] > 0.0 and off > settled:
            change[0, column], change[1, column] = (shift - centre) / scale, scale / new
            scale_of[0], shift_of[0], any_ = new, centre, True
    return any_
