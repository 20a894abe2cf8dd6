"""A block of samples pooled into the units of its columns as a compiled loop, see :class:`RunningScale`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from ...running_scale import ALIEN, BLOCK, BURST_CLIP, CLIP, COMPANY, DOUBT, REST, SPIKES, TRIMMED
from .numba_memory import A1, COMMON, INT, TINY, F, inner, matrix_at, vector_at


@inner(F(A1, F))
def _trimmed(squares, part):
    """Root of the mean of n squares in order without the last n/part."""
    kept, total = max(squares.shape[0] - math.ceil(squares.shape[0] / part), 0), 0.0
    for i in range(kept):
        total += squares[i]
    return math.sqrt(total / max(kept, 1))


@njit(types.void(INT, INT, INT, F, INT, INT, INT, INT, INT, INT, INT), **COMMON)
def pool_columns(models, n, columns, memory, block, on, shifted, weights, centres, spreads, large):
    """The pooled figures of each model's columns take a block ``(n, columns)`` in; all given by addresses."""
    x, away = np.empty(n), np.empty(n)
    for column in range(models * columns):
        b, c = column // columns, column % columns
        rows, here, counts = matrix_at(block, b, n, columns), vector_at(on, b, n), vector_at(large, column, 2)
        shift, size = vector_at(shifted, 0, columns)[c], 0
        for i in range(n):
            if here[i] > 0.0:
                x[size] = rows[i, c]
                size += 1
        order, count, most = np.sort(x[:size]), float(size), TINY
        middle = order[(size - 1) // 2] if shift * count > 0 else 0.0
        for i in range(n):
            away[i] = rows[i, c] - middle if here[i] > 0.0 else 0.0
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
