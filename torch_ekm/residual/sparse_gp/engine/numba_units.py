"""A block of samples pooled into the units of its columns, see :class:`RunningScale`, as a compiled loop."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from ...running_scale import ALIEN, BLOCK, BURST_CLIP, CLIP, COMPANY, DOUBT, REST, SPIKES, TRIMMED
from .numba_math import A1, COMMON, INNER, INT, TINY, F, matrix_at, vector_at


@njit(F(A1, INT, F), **INNER)
def _trimmed(squares, n, part):
    """Root of the mean of n squares in order without the last n/part."""
    kept, total = max(n - math.ceil(n / part), 0), 0.0
    for i in range(kept):
        total += squares[i]
    return math.sqrt(total / max(kept, 1))


@njit(types.void(A1, A1, F, F, F, A1, A1), **INNER)
def _of_block(x, on, shifted, weight, memory, large, found):
    """``found``: count, centre and spread of a column; ``large``: counts, which take its large samples in."""
    n, count, k = x.shape[0], 0, 0
    for i in range(n):
        count += 1 if on[i] > 0.0 else 0
    order = np.empty(count)
    for i in range(n):
        if on[i] > 0.0:
            order[k] = x[i]
            k += 1
    order.sort()
    middle, most = order[(count - 1) // 2] if shifted * count > 0 else 0.0, TINY
    away = np.empty(n)
    for i in range(n):
        away[i] = x[i] - middle if on[i] > 0.0 else 0.0
        most = max(most, abs(away[i]))
    k = 0
    for i in range(n):
        away[i] /= most
        if on[i] > 0.0:
            order[k] = away[i] * away[i]
            k += 1
    order.sort()
    few, many = _trimmed(order, count, TRIMMED[0]), _trimmed(order, count, TRIMMED[1])
    typical = many if many > SPIKES * few else few
    bound, all_, alone = CLIP * typical if typical > 0.0 else 1.0, 0.0, 0.0
    for i in range(n):
        if abs(away[i]) > bound:
            near = (i > 0 and abs(away[i - 1]) > bound) or (i < n - 1 and abs(away[i + 1]) > bound)
            all_, alone = all_ + 1.0, alone + (0.0 if near else 1.0)
    fade = 1.0 - BLOCK / memory
    large[0], large[1] = large[0] * fade + all_, large[1] * fade + alone
    share = large[0] / max(min(weight, memory) + count, 1.0)
    by_chance = (1.0 - min(share, 1.0)) ** 2
    if large[1] + DOUBT < COMPANY * by_chance * (large[0] + DOUBT):
        bound *= BURST_CLIP
    mean, spread = 0.0, 0.0
    for i in range(n):
        away[i] = min(max(away[i], -bound), bound)
        mean += away[i]
    mean = mean / max(count, 1) * shifted
    for i in range(n):
        spread += (away[i] - mean) ** 2 if on[i] > 0.0 else 0.0
    found[0], found[1], found[2] = count, middle + most * mean, most * math.sqrt(spread / max(count, 1))


@njit(types.void(INT, INT, INT, F, INT, INT, INT, INT, INT, INT, INT), **COMMON)
def pool_columns(models, n, columns, memory, block, on, shifted, weights, centres, spreads, large):
    """The pooled figures of each model's columns take a block ``(n, columns)`` in; all given by addresses."""
    x, found, shifts = np.empty(n), np.empty(3), vector_at(shifted, 0, columns)
    for b in range(models):
        rows, here = matrix_at(block, b, n, columns), vector_at(on, b, n)
        weight, centre_ = vector_at(weights, b, columns), vector_at(centres, b, columns)
        spread_ = vector_at(spreads, b, columns)
        for c in range(columns):
            for i in range(n):
                x[i] = rows[i, c]
            _of_block(x, here, shifts[c], weight[c], memory, vector_at(large, b * columns + c, 2), found)
            count, centre, spread = found
            past = spread_[c] if spread == 0.0 or spread > ALIEN * spread_[c] else 0.0
            count *= REST[1] if spread < REST[0] * past else 1.0
            before = min(weight[c], memory) if past == spread_[c] else 0.0
            weight[c] = before + count
            part, gap = count / max(weight[c], TINY), centre - centre_[c] if before > 0.0 else 0.0
            most = max(abs(gap), past, spread, TINY)
            inside = (1.0 - part) * math.sqrt(past / most) + part * math.sqrt(spread / most)
            spread_[c] = most * math.sqrt(inside**4 + (1.0 - part) * part * (gap / most) ** 2)
            centre_[c] = (centre_[c] if before > 0.0 else centre) + part * gap
