"""Where hand and object are: the state of a grasp, poses and Jacobians of the hand's links."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import nn

from .._arrays import as_tensors, is_plain
from .._checks import check_finite, check_kind, check_last, check_shape
from .._extras import require
from ..description import HandDescription
from ..exceptions import ParameterError, ShapeError, UnknownNameError
from ..typing import Array, Bool, Float, Tensor
from .se3 import cross, exp, log

A_STATE = "a GraspState, e.g. observation.state"
_ROUNDED = 1e-4
"""What a rotation matrix may be off by, entry by entry: four digits are enough, a scale or a shear is not."""


@dataclass(frozen=True)
class GraspState:
    """Joint angles ``q`` [rad] and object pose: point ``o`` [m] and rotation ``R``, in the hand frame.

    Arrays and nested lists are converted, and all three get the widest of their precisions.

    Raises:
        ShapeError: the three do not belong together.
        NonFiniteError: any entry is NaN or infinite.
        ParameterError: ``rotation`` is none (scaled, sheared, a reflection), or there are no numbers.
    """

    q: Float[Tensor, "*batch n_q"]
    position: Float[Tensor, "*batch 3"]
    rotation: Float[Tensor, "*batch 3 3"]

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in ("q", "position", "rotation")}
        for name, value in zip(given, as_tensors(**given), strict=True):
            object.__setattr__(self, name, value)  # the dataclass is frozen
        if self.q.dim() == 0:
            raise ShapeError("q", "(*batch, n_q)", self.q.shape)
        check_shape("position", self.position, (*self.q.shape[:-1], 3), "to go with q")
        check_shape("rotation", self.rotation, (*self.q.shape[:-1], 3, 3), "to go with q")
        total = self.q.sum() + self.position.sum() + self.rotation.sum()  # an infinity or a NaN is in it
        if not math.isfinite(total):
            for name in given:
                check_finite(name, getattr(self, name))
        check_rotation(self.rotation)

    @property
    def n_s(self) -> int:
        """Size of an increment: ``n_q + 6``."""
        return self.q.shape[-1] + 6

    def plus(self, ds: Float[Tensor, "*batch n_s"]) -> GraspState:
        """Retraction: ``q + dq``, ``o + do``, ``exp([dphi]x) R``."""
        (ds,), n_q = as_tensors(ds=ds), self.q.shape[-1]
        check_last("ds", ds, n_q + 6, "it is [dq; do; dphi]")
        dq, do, dphi = ds.split([n_q, 3, 3], dim=-1)
        return GraspState(self.q + dq, self.position + do, exp(dphi) @ self.rotation)

    def minus(self, earlier: GraspState) -> Float[Tensor, "*batch n_s"]:
        """``ds`` with ``earlier.plus(ds) = self``: ``[q+ - q; o+ - o; Log(R+ R^T)]``."""
        check_kind("state", earlier, GraspState, A_STATE)
        dphi = log(self.rotation @ earlier.rotation.mT)
        return torch.cat([self.q - earlier.q, self.position - earlier.position, dphi], dim=-1)


def check_rotation(R: Tensor) -> None:
    """``cof R = R``: every column is the cross product of the other two, which holds for rotations only."""
    rows = R.detach().numpy() if is_plain(R.detach()) else R.detach()
    y_z_x, z_x_y = (rows.mT[..., order, :] for order in ([1, 2, 0], [2, 0, 1]))  # columns of R
    off = abs(cross(y_z_x, z_x_y) - rows.mT).max()
    if float(off) > _ROUNDED:
        what = "a reflection" if bool((torch.linalg.det(R) < 0).any()) else "scaled or sheared"
        valid = f"a rotation matrix, R^T R = I and det R = 1 (it is {what}, off by {float(off):.2g})"
        raise ParameterError("rotation", R.tolist() if R.dim() == 2 else tuple(R.shape), valid)


@dataclass(frozen=True)
class LinkPoses:
    """``T_hand_link`` of every link, in the order of ``link_names``."""

    transforms: Float[Tensor, "*batch n_link 4 4"]
    """Homogeneous transforms [m], link frame to hand frame."""
    link_names: tuple[str, ...]

    def of(self, name: str) -> Float[Tensor, "*batch 4 4"]:
        """Pose of one link.

        Raises:
            UnknownNameError: there is no such link; the message lists all.
        """
        return self.transforms[..., _place(name, self.link_names), :, :]


def _place(name: str, names: tuple[str, ...]) -> int:
    if name not in names:
        raise UnknownNameError("link", name, names)
    return names.index(name)


@runtime_checkable
class Kinematics(Protocol):
    """Forward kinematics of a hand in the hand frame: :class:`HandKinematics` or one's own."""

    @property
    def link_names(self) -> tuple[str, ...]: ...

    @property
    def upstream(self) -> Tensor:
        """``[link, joint]``: the joint moves the link, bool ``(n_link, n_q)``."""
        ...

    @property
    def dtype(self) -> torch.dtype: ...

    def __call__(self, q: Tensor, /) -> LinkPoses:
        """Poses of all links at joint angles [rad]."""
        ...

    def joint_axes(self, poses: LinkPoses, /) -> tuple[Tensor, Tensor]:
        """Unit axis of every joint and a point on it [m], ``(*batch, n_q, 3)`` each."""
        ...


class HandKinematics(nn.Module):
    r"""``T_j(q) = T_parent(j) O_j exp([z_j] q_j)``, for every link of the tree.

    ``O_j`` is the joint's origin in its parent link, ``z_j`` its unit axis. The poses are those of a
    pytorch-kinematics chain that is built from ``hand.urdf`` in the precision of this module (the
    library's own URDF reader builds origins in float32); axes and Jacobians follow from the poses.
    All of them are in the hand frame ``hand.base_link`` [m, rad]; Jacobian rows are ``(v; w)``.

    Differentiable any number of times, by autograd and by ``torch.func.jacrev``, ``jacfwd`` and
    ``hessian``. ``torch.func.vmap`` over ``q`` is refused by the chain, which writes in place: pass the
    batch dimensions, which cost less.

    Args:
        hand: the hand; links and joints keep its names and order.
        dtype: of the buffers, and then of ``q``; change it later with ``.to()``.

    Raises:
        MissingExtraError: pytorch-kinematics is not installed.
    """

    upstream: Bool[Tensor, "n_link n_q"]
    """True where the joint moves the link."""
    _frame_of_link: Tensor
    _joint_order: Tensor | None  # None: that of ``q``
    _child_of_joint: Tensor
    _axes: Tensor

    def __init__(self, hand: HandDescription, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.hand = hand
        self.link_names = hand.link_names
        self.joint_names = hand.joint_names
        self._chain = chain = _build_chain(hand, dtype, torch.device("cpu"))
        joints = {joint.name: joint for joint in hand.urdf.joints}
        frames = torch.tensor([chain.frame_to_idx[name] for name in self.link_names])
        children = [self.link_names.index(joints[name].child) for name in self.joint_names]
        above = torch.zeros(len(frames), len(frames), dtype=torch.bool)  # frame, frame on the way to it
        for frame, path in enumerate(chain.parents_indices):
            above[frame, path] = True
        order = [self.joint_names.index(name) for name in chain.get_joint_parameter_names()]
        for name, value in {
            "_frame_of_link": frames,
            "_joint_order": None if order == sorted(order) else torch.tensor(order),
            "_child_of_joint": torch.tensor(children),
            "_axes": torch.tensor([joints[name].axis.tolist() for name in self.joint_names], dtype=dtype),
            "upstream": above[frames][:, frames[children]],
        }.items():
            self.register_buffer(name, value, persistent=False)  # made from the description, never learned

    def _apply(self, fn: Any, recurse: bool = True) -> HandKinematics:
        super()._apply(fn, recurse)
        self._chain = _build_chain(self.hand, self._axes.dtype, self._axes.device)  # it is no Module
        self.__dict__.pop("_at_zero", None)
        return self

    @property
    def dtype(self) -> torch.dtype:
        """Of the buffers, and so of the ``q`` that :meth:`forward` takes."""
        return self._axes.dtype

    def link_index(self, name: str) -> int:
        """Place of a link in ``link_names``.

        Raises:
            UnknownNameError: there is no such link; the message lists all.
        """
        return _place(name, self.link_names)

    def forward(self, q: Float[Tensor, "*batch n_q"]) -> LinkPoses:
        """Poses of all links at joint angles ``q`` [rad]; a NaN angle gives NaN poses.

        Raises:
            ShapeError: the last dimension is not ``n_q``; the message lists the joints in order.
            ParameterError: ``q`` has another dtype than this module.
        """
        check_kind("q", q, Tensor, "a tensor: torch.as_tensor(q)")
        check_last("q", q, len(self.joint_names), f"the joints are, in order: {', '.join(self.joint_names)}")
        if q.dtype != self._chain.dtype:
            valid = f"{self.dtype}, the dtype of this module (change it with .to())"
            raise ParameterError("q.dtype", q.dtype, valid)
        if is_plain(q):
            return LinkPoses(torch.from_numpy(self._by_exponentials(q.numpy())), self.link_names)
        return self._by_chain(q)

    def _by_exponentials(self, q: Array) -> Array:
        """``T_l(q) = prod_j exp(xi_j q_j) T_l(0)`` over the joints upstream of the link, xi_j at q = 0.

        The chain takes four times as long for one posture, twice for some tens.
        """
        transforms, axis, origin, order, joint_of_link = self._at_zero
        R = exp(axis * q[..., None])
        # by each joint and those before it; the last: by none
        moved = np.zeros((*q.shape[:-1], q.shape[-1] + 1, 4, 4))
        moved[..., 3, 3] = 1.0
        moved[..., :-1, :3, :3], moved[..., -1, :3, :3] = R, np.eye(3)
        moved[..., :-1, :3, 3] = origin - (R @ origin[..., None])[..., 0]
        for j, before in order:
            moved[..., j, :, :] = moved[..., before, :, :] @ moved[..., j, :, :]
        return moved.take(joint_of_link, axis=-3) @ transforms

    @cached_property
    def _at_zero(self) -> tuple[Array, Array, Array, list[tuple[int, int]], list[int]]:
        """At q = 0: poses, axes, a point on each axis; joints on top of another one, with that one; the last
        joint that moves each link (-1: none does)."""
        with torch.no_grad():
            poses = self._by_chain(self._axes.new_zeros(len(self.joint_names)))
            axis, origin = self.joint_axes(poses)
        upstream = self.upstream.numpy()
        above = upstream[self._child_of_joint.numpy()]  # [j, i]: joint i moves the link behind joint j
        depth = above.sum(1)
        deepest = [
            np.where(rows, depth, 0).argmax(1) for rows in (above & (depth < depth[:, None]), upstream)
        ]
        last = np.where(depth > 1, deepest[0], -1).tolist()
        joint_of_link = np.where(upstream.any(1), deepest[1], -1).tolist()
        order = [(int(j), last[j]) for j in np.argsort(depth, kind="stable") if last[j] >= 0]
        return poses.transforms.numpy(), axis.numpy(), origin.numpy(), order, joint_of_link

    def _by_chain(self, q: Tensor) -> LinkPoses:
        shape, flat = q.shape, q.reshape(-1, len(self.joint_names))
        if self._joint_order is not None:
            flat = flat.index_select(1, self._joint_order)
        # the library's analytical gradient is a custom Function: once differentiable, not by torch.func
        frames = self._chain.forward_kinematics_tensor(flat, analytical_grad=False)
        transforms = frames.transpose(0, 1).index_select(1, self._frame_of_link)
        return LinkPoses(transforms.view(*shape[:-1], len(self.link_names), 4, 4), self.link_names)

    def joint_axes(
        self, poses_or_q: LinkPoses | Float[Tensor, "*batch n_q"]
    ) -> tuple[Float[Tensor, "*batch n_q 3"], Float[Tensor, "*batch n_q 3"]]:
        """``z_j = R_j e_j`` and a point ``o_j`` [m] on it, of every joint, in the hand frame."""
        poses = poses_or_q if isinstance(poses_or_q, LinkPoses) else self(poses_or_q)
        used: tuple[Any, ...] = poses.transforms, self._child_of_joint, self._axes
        plain = is_plain(poses.transforms, self._axes)
        transforms, at, axes = (x.numpy() for x in used) if plain else used
        child = transforms[..., at, :, :]
        axis, origin = (child[..., :3, :3] @ axes[..., None])[..., 0], child[..., :3, 3]
        return (torch.from_numpy(axis), torch.from_numpy(origin)) if plain else (axis, origin)

    def jacobian(
        self,
        q: LinkPoses | Float[Tensor, "*batch n_q"],
        link: str | int,
        point: Float[Tensor, "*points 3"] | None = None,
    ) -> Float[Tensor, "*batch 6 n_q"]:
        """``J[:, j] = (z_j x (x - o_j); z_j)`` for joints that move the link, 0 for the others.

        ``(v; w) = J dq``: velocity [m/rad] of the point ``x`` and angular velocity of the link, hand frame.

        Args:
            q: joint angles [rad], or the poses already computed from them.
            link: name, or place in ``link_names``.
            point: in the link's frame [m]; its origin if None.

        Raises:
            UnknownNameError: there is no such link.
            ShapeError: ``q`` or ``point`` does not fit.
        """
        poses = q if isinstance(q, LinkPoses) else self(q)
        k = self.link_index(link) if isinstance(link, str) else link
        T = poses.transforms[..., k, :, :]
        x = T[..., :3, 3]
        if point is not None:
            check_last("point", point, 3, "it is a point in the link's frame")
            x = x + (T[..., :3, :3] @ point[..., None])[..., 0]
        axis, origin = self.joint_axes(poses)
        v = torch.linalg.cross(axis, x[..., None, :] - origin)
        moves = self.upstream[k][:, None]
        return (torch.cat([v, axis.expand_as(v)], dim=-1) * moves).mT

    def extra_repr(self) -> str:
        return f"'{self.hand.name}', links={len(self.link_names)}, joints={len(self.joint_names)}"


def _build_chain(hand: HandDescription, dtype: torch.dtype, device: torch.device) -> Any:
    """The ``pytorch_kinematics`` chain of a hand, its world frame the hand frame.

    Made of the library's own frames, so that origins and axes are those of the description to the last
    digit.
    """
    pk = require("pytorch_kinematics")
    to = {"dtype": dtype, "device": device}

    def offset(transform: np.ndarray) -> Any:
        return pk.Transform3d(matrix=torch.from_numpy(transform).to(**to))

    urdf = hand.urdf
    frames = {link.name: pk.Frame(link.name, pk.Link(link.name)) for link in urdf.links}
    for joint in urdf.joints:
        kind, origin = "revolute" if joint.name in hand.joint_names else "fixed", offset(joint.transform)
        frames[joint.child].joint = pk.Joint(joint.name, origin, kind, joint.axis.tolist(), **to)
        frames[joint.parent].add_child(frames[joint.child])
    # the hand frame may sit behind fixed joints
    frames[urdf.root].link.offset = offset(np.linalg.inv(urdf.pose(hand.base_link)))
    chain = pk.Chain(frames[urdf.root], **to)
    # The frames of a level are neighbours: slices read and write them without a gather, a tenth faster. The
    # library has no other place where levels could be given: it makes index tensors of them.
    chain._bfs_levels = [slice(int(level[0]), int(level[-1]) + 1) for level in chain._bfs_levels]
    return chain
