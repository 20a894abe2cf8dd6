"""What compiled loops know of a sparse GP: a row of integers, sizes and addresses, in the order of this file.

An address is that of the first double of a buffer, one model's after the other's; 0: there is none.
"""

from __future__ import annotations

(
    MODELS, SLOTS, IN, OUT,
    WIDTH,  # of inputs as the kernel sees them: embedded by a deep kernel
    KIND,  # of the kernel, see engine.numba_kernels
    ACTIONS,  # last columns in which the kernel is linear
    OWN, OWN_UNITS,  # 1: each model has its own kernel, its own units; 0: all share one
    FIGURES,  # novelty threshold, jitter, square of a robust weight's threshold (0: none)
    BASIS, ACTIVE, COUNT, SLOT, MOMENTS, VECTORS, PENDING, LARGEST, LOG_NOISE,
    LOG_LENGTHSCALE, LOG_VARIANCE, LOG_ACTION, SHIFT, SCALE, SHIFT_Y, SCALE_Y, REACH,
    LAYERS, WIDTHS, WEIGHTS, EMBEDDED,  # of a deep kernel: its network, and the basis as it sees it
    BLOCK, BLOCK_ON, BLOCK_Y, BLOCK_ON_Y, BLOCK_SIZE,  # Standardize
    DISTRUSTED,  # RobustWeight
    FACTOR,  # CalibrateNoise
    CHANGED, RING_X, RING_Y, RING, MISLED,  # DetectChanges
    WINDOW_X, WINDOW_Y, WINDOW, WINDOW_SIZE,  # LearnHyperparameters
    PAST_X, PAST_Y, PAST, PAST_ABSORBED, PAST_NUMBER, PAST_SIZE,  # its memory
    FIELDS,
) = range(54)  # fmt: skip

#: what an update does: nothing but predict, learn, and take notes of the sample for the parts
(MODE, BLOCK_PLACE, RING_PLACE, WINDOW_PLACE, PAST_PLACE, NUMBER, TURNS) = range(7)
SKIP, LEARN, NOTE = range(3)
