"""One code for tensors and numpy arrays; tensors of any input; linear algebra that several parts need.

Equations are written in what ``torch`` and ``numpy`` share (:func:`namespace`). Tensors carry batches and
derivatives. One state without a derivative is computed in arrays, in which a small operation costs a third:
:func:`in_numpy` and :func:`in_torch` convert, without a copy.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch.autograd.forward_ad import unpack_dual

from .exceptions import ParameterError
from .typing import AnyArray, Array, Float, Tensor

T = TypeVar("T")


def namespace(x: AnyArray) -> Any:
    """``torch`` or ``numpy``: the module whose functions take x."""
    return torch if isinstance(x, Tensor) else np


def is_plain(*values: Tensor) -> bool:
    """Numbers alone: float64 on the CPU, without a derivative, and none that stand for others (vmap)."""
    for x in values:
        if type(x) is not Tensor or x.dtype is not torch.float64 or not x.is_cpu or x.requires_grad:
            return False
        if unpack_dual(x).tangent is not None:
            return False
        try:
            x.data_ptr()
        except RuntimeError:
            return False
    return True


def zeros(like: AnyArray, *shape: int) -> Any:
    """Zeros of the kind of ``like``."""
    return like.new_zeros(shape) if isinstance(like, Tensor) else np.zeros(shape)


def eye(like: AnyArray, n: int) -> Any:
    """The unit matrix of the kind of ``like``."""
    return torch.eye(n, dtype=like.dtype, device=like.device) if isinstance(like, Tensor) else np.eye(n)


def norm(x: AnyArray) -> Any:
    """``|x|`` along the last axis."""
    return torch.linalg.vector_norm(x, dim=-1) if isinstance(x, Tensor) else np.sqrt((x * x).sum(-1))


def like(value: Tensor, other: AnyArray) -> Any:
    """A tensor as it is, or as an array where ``other`` is one."""
    return value if isinstance(other, Tensor) else value.detach().numpy()


def in_numpy(data: T) -> T:
    """A dataclass, whose fields were checked, with arrays in place of its tensors."""
    return _converted(data, Tensor, lambda x: x.detach().numpy())


def in_torch(data: T) -> T:
    """A dataclass with tensors in place of its arrays."""
    return _converted(data, np.ndarray, torch.from_numpy)


def _converted(data: T, kind: type, convert: Any) -> T:
    fields = {name: convert(x) if isinstance(x, kind) else x for name, x in vars(data).items()}
    return of_fields(type(data), **fields)


def of_fields(of: type[T], **fields: Any) -> T:
    """A dataclass, unchecked: its fields may be arrays in place of tensors."""
    made = object.__new__(of)
    made.__dict__.update(fields)
    return made


def as_tensors(**values: object) -> list[Tensor]:
    """Tensors, arrays and nested lists as floating-point tensors of one dtype, without a copy where possible.

    The dtype is the widest of theirs, where lists and integers count as float64.

    Raises:
        ParameterError: something is not made of numbers.
    """
    tensors = [value for value in values.values() if isinstance(value, Tensor)]
    dtypes = {value.dtype for value in tensors}
    dense = all(value.layout is torch.strided for value in tensors)
    if dense and len(tensors) == len(values) and len(dtypes) == 1 and dtypes.pop().is_floating_point:
        return tensors
    try:
        given = [torch.as_tensor(v).dtype if hasattr(v, "dtype") else torch.float64 for v in values.values()]
        if any(dtype.is_complex for dtype in given) or not dense:
            raise TypeError("real, and not sparse")
        wide = [dtype if dtype.is_floating_point else torch.float64 for dtype in given]
        dtype = functools.reduce(torch.promote_types, wide)
        return [torch.as_tensor(value, dtype=dtype) for value in values.values()]
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        valid = f"numbers, in a tensor, an array or nested lists ({error})"
        raise ParameterError(", ".join(values), tuple(values.values()), valid) from None


def as_states(x: AnyArray, dims: int) -> Array:
    """A list of states in numpy: the batch of ``x`` flattened, ``dims`` axes of each state left."""
    x = x.detach().double().cpu().numpy() if isinstance(x, Tensor) else x
    return x.reshape(-1, *x.shape[x.ndim - dims :])


def null_space(rows: Float[AnyArray, "m n"]) -> Float[Any, "n n_free"]:
    """Orthonormal basis N of ``rows N = 0`` (SVD); all of space where there are no rows.

    Args:
        rows: constraints whose entries compare with 1: angles, or lengths divided by a typical one. Singular
            values up to 1e-9 count as 0.
    """
    _, sigma, Vh = namespace(rows).linalg.svd(rows, full_matrices=True)
    return Vh[int((sigma > 1e-9).sum()) :].mT


_MOST_CHANGES = 25
_VIOLATED = 1e-10  # of rows of the order of 1
_ERROR = 1e-9


class EqualityProgram:
    """``min 1/2 x^T P x + q^T x, A x = b``, solved again and again with more rows.

    Raises:
        numpy.linalg.LinAlgError: rows of A depend on each other, or P is singular on their null space.
    """

    def __init__(self, P: Array, q: Array, A: Array, b: Array) -> None:
        self._n, m = len(q), len(b)
        self._K = np.zeros((self._n + m, self._n + m))
        self._K[: self._n, : self._n] = P
        self._K[: self._n, self._n :], self._K[self._n :, : self._n] = A.T, A
        self._inverse = np.linalg.inv(self._K)
        self._right = np.concatenate([-q, b])  # of the conditions for x and the multipliers of A
        z = self._inverse @ self._right
        self._z = z + self._inverse @ (self._right - self._K @ z)  # refined: rounding of a poor condition
        self.x: Array = self._z[: self._n]
        """The optimum."""

    def solve(self, E: Array, e: Array) -> tuple[Array, Array, Any]:
        """The optimum with ``E x = e`` on top, and the multipliers of A and of E.

        Raises:
            numpy.linalg.LinAlgError: the rows depend on each other and on A.
        """
        n, H_E = self._n, self._inverse[:, : self._n] @ E.T
        lam = np.linalg.solve(E @ H_E[:n], E @ self.x - e)
        z = self._z - H_E @ lam
        return z[:n], z[n:], lam

    def error(self, x: Array, nu: Array, push: Array) -> float:
        """``max(|P x + q + A^T nu + push|, |A x - b|)`` as a share of the largest of q and b, or of 1."""
        left = self._right - self._K @ np.concatenate([x, nu])
        left[: self._n] -= push
        return float(abs(left).max() / max(1.0, abs(self._right).max()))


class Optimum(NamedTuple):
    """x, and what certifies it."""

    x: Array
    equality: Array
    """nu, multipliers of ``A x = b``."""
    active: list[int]
    """W, rows of G that hold with equality."""
    inequality: Array
    """lam, their multipliers."""


def solve_by_active_set(program: EqualityProgram, G: Array, h: Array, active: list[int]) -> Optimum | None:
    """The optimum with ``G x <= h``, by guessing which rows W hold with equality, ``active`` first::

        P x + q + A^T nu + G_W^T lam = 0,  A x = b,  G_W x = h_W,  lam >= 0,  G x <= h

    From one guess to the next the row with the most negative multiplier leaves, or else the row that is
    violated most enters. An answer keeps all conditions of Karush, Kuhn and Tucker and is exact to rounding;
    where none is found (None) an interior-point method has to do it. At a vertex, where as many rows hold as
    there are unknowns, rounding decides which row leaves, and none may be found. See Nocedal and Wright,
    Numerical Optimization (2006), ch. 16.
    """
    rows = list(active)
    for _ in range(_MOST_CHANGES):
        try:
            x, nu, lam = program.solve(G[rows], h[rows])
        except np.linalg.LinAlgError:
            return None
        if len(rows) and lam.min() < 0:
            del rows[int(lam.argmin())]
            continue
        broken = G @ x - h
        broken[rows] = 0.0
        if broken.max(initial=0.0) <= _VIOLATED:
            right = program.error(x, nu, lam @ G[rows]) <= _ERROR  # not so where A is nearly singular
            return Optimum(x, nu, rows, lam) if right else None
        rows.append(int(broken.argmax()))
    return None
