"""Shape annotations, in one place.

``Float[Tensor, "*batch n_q"]`` documents a shape everywhere. The annotations are never
evaluated in use; without jaxtyping (the core needs torch and numpy alone) they are inert.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor as Tensor

Array = NDArray[np.float64]

if TYPE_CHECKING:
    from typing import Any

    #: A tensor or a numpy array, see ``torch_ekm._arrays``: what both can do has no type of its own.
    AnyArray = Any
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Int as Int
else:
    AnyArray = Tensor | np.ndarray
    try:
        from jaxtyping import Bool, Float, Int
    except ModuleNotFoundError:

        class _Inert:
            def __class_getitem__(cls, item):
                return Tensor

        Bool = Float = Int = _Inert

__all__ = ["AnyArray", "Array", "Bool", "Float", "Int", "Tensor"]
