"""What compiled loops know of a sparse GP, or of a mixture: a row of integers, sizes and addresses.

An address is that of the first double of a buffer, one model's after the other's; 0: there is none.
"""

from __future__ import annotations

(
    MODELS, SLOTS, IN, OUT,
    WIDTH,  # of inputs as the kernel sees them: in its lengthscales, with a network's features behind
    VALUES,  # width of the input and all layers of a network
    KIND,  # of the kernel, see engine.numba_kernels
    ACTIONS,  # last columns in which the kernel is linear
    FIGURES,  # novelty threshold, jitter, square of a robust weight's threshold (0: none)
    BASIS, ACTIVE, COUNT, SLOT, MOMENTS, VECTORS, PENDING, LARGEST, LOG_NOISE,
    LOG_LENGTHSCALE, LOG_VARIANCE, LOG_ACTION, SHIFT, SCALE, SHIFT_Y, SCALE_Y, REACH,
    EMBEDDED,  # the basis as the kernel sees it
    LAYERED,  # the basis with all layers of a network behind
    LAYERS, NETWORK,  # of a deep kernel: rows of widths before and behind a layer, addresses of weights,
    # biases (0: the last layer has none) and weights the other way round
    ROOM,  # for what an update finds of its sample
    RECENT_X, RECENT_Y, RECENT_ON, RECENT, RECENT_SIZE,  # of the last samples, with weights
    DISTRUSTED,  # RobustWeight
    FACTOR,  # CalibrateNoise
    CHANGED, LEVELS, MISLED,  # DetectChanges
    N_STEPS,  # LearnHyperparameters
    LEARNING,  # samples of the window, of the memory in a step; parameters, entries of their gradient
    PARAMETERS,  # rows of addresses of one and Adam's moments, size, place in the gradient, 1 (noise: 2) if
    # it is a logarithm
    SUMS,  # of the queries of a step so far
    RATES,  # of a step, square of a robust weight's threshold (0: none), factor of forgetting
    FIELDS,
) = range(47)  # fmt: skip
#: of a mixture behind these, of which it has MODELS, IN, OUT and LARGEST
(
    N_EXPERTS, N_SHARES, N_TAILS,
    EXPERTS,  # rows h, kappa, rho, beta, c, a column for each expert, those of the first learner first
    PRIOR, EVIDENCE, INNOVATION, LEVEL, TREND, GAIN, MASS, SHIFTS, SPREAD, OFFSET, INFLATION, N_SEEN,
    RATES_OF_TAILS, FREEDOMS, AT_ZERO,  # of the tails' laws, and their log density at 0
    TAIL_SCALE, TAIL_EVIDENCE, NOISE_EVIDENCE, NOISE_SHARES, FIELDS_OF_MIXTURE,
) = range(FIELDS, FIELDS + 24)  # fmt: skip
