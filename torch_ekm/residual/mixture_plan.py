"""What compiled loops know of a mixture: a row of integers, sizes and addresses, as of a sparse GP."""

from __future__ import annotations

from .sparse_gp import plan as P

#: fields of ``g`` after those of a plan, of which it has MODELS, IN, OUT and LARGEST
(
    N_EXPERTS, N_SHARES, N_TAILS,
    EXPERTS,  # rows h, kappa, rho, beta, c, a column for each expert, those of the first learner first
    PRIOR, EVIDENCE, INNOVATION, LEVEL, TREND, GAIN, MASS, SHIFT, SPREAD, OFFSET, INFLATION, COUNT,
    RATES, FREEDOMS, AT_ZERO,  # of the tails' laws, and their log density at 0
    TAIL_SCALE, TAIL_EVIDENCE, NOISE_EVIDENCE, NOISE_SHARES, FIELDS,
) = range(P.FIELDS, P.FIELDS + 24)  # fmt: skip
