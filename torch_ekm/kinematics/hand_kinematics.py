"""Forward kinematics and geometric Jacobians of a whole hand: a tree, batched, differentiable."""

from __future__ import annotations

import torch
from torch import nn

from ..description import HandDescription, UrdfModel, read_urdf
from ..exceptions import ParameterError, ShapeError, UnknownNameError
from ..typing import Bool, Float, Tensor
from .link_poses import LinkPoses
from .se3 import hat


class HandKinematics(nn.Module):
    r"""``T_j(q) = T_parent(j) O_j exp([z_j] q_j)``, for every link of the tree.

    ``O_j`` is the joint's origin in its parent link, ``z_j`` its unit axis. By Rodrigues the local
    transform is linear in ``(1, sin q_j, 1 - cos q_j)`` with constant matrices, so all joints are turned at
    once, and the tree is then multiplied level by level (five fingers at a time) instead of joint by joint.
    All poses, axes and Jacobians are in the hand frame ``hand.base_link`` [m, rad]; Jacobian rows are
    ``(v; w)``. Differentiable any number of times, and usable under ``torch.func``.
    :func:`~torch_ekm.kinematics.reference.reference_transforms` is the same map through pytorch-kinematics.

    Args:
        hand: the hand; links and joints keep its names and order.
        dtype: of the buffers, and then of ``q``; change it later with ``.to()``.
    """

    upstream: Bool[Tensor, "n_link n_q"]
    """True where the joint moves the link."""
    # one entry per link, level by level from the root
    _constant: Tensor
    _sine: Tensor
    _versine: Tensor
    _joint_of_link: Tensor
    _unsort: Tensor
    # one entry per joint
    _child_of_joint: Tensor
    _axes: Tensor

    def __init__(self, hand: HandDescription, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.hand = hand
        self.link_names = hand.link_names
        self.joint_names = hand.joint_names
        urdf = hand.urdf if hand.urdf is not None else read_urdf(hand.urdf_path)
        self._build(urdf, dtype)

    def _build(self, urdf: UrdfModel, dtype: torch.dtype) -> None:
        n_link, n_q = len(self.link_names), len(self.joint_names)
        index = {name: k for k, name in enumerate(self.link_names)}
        of_child = {joint.child: joint for joint in urdf.joints}
        constant = torch.eye(4, dtype=torch.float64).repeat(n_link, 1, 1)
        sine, versine = torch.zeros_like(constant), torch.zeros_like(constant)
        upstream = torch.zeros(n_link, n_q, dtype=torch.bool)
        joint_of_link, child_of_joint = [0] * n_link, [0] * n_q
        axes = torch.zeros(n_q, 3, dtype=torch.float64)

        levels: list[list[int]] = [[index[urdf.root]]]
        parents: list[list[int]] = [[0]]  # place of the parent in the level above
        while levels[-1]:
            level, above = [], []
            for place, parent in enumerate(levels[-1]):
                for name in self.link_names:
                    joint = of_child.get(name)
                    if joint is None or joint.parent != self.link_names[parent]:
                        continue
                    link = index[name]
                    level.append(link)
                    above.append(place)
                    origin = torch.from_numpy(joint.transform.copy())
                    constant[link] = origin
                    upstream[link] = upstream[parent]
                    if joint.name in self.joint_names:
                        j = self.joint_names.index(joint.name)
                        joint_of_link[link], child_of_joint[j] = j, link
                        axes[j] = torch.from_numpy(joint.axis.copy())
                        K = hat(axes[j])
                        sine[link, :3, :3] = origin[:3, :3] @ K
                        versine[link, :3, :3] = origin[:3, :3] @ K @ K
                        upstream[link, j] = True
            levels.append(level)
            parents.append(above)
        levels.pop()
        parents.pop()

        # the hand frame may sit behind fixed joints: start the tree at inv(T_root_base)
        base, T = self.hand.base_link, torch.eye(4, dtype=torch.float64)
        while base != urdf.root:
            T = constant[index[base]] @ T
            base = of_child[base].parent
        constant[index[urdf.root]] = torch.linalg.inv(T)

        order = [link for level in levels for link in level]
        self._sizes = [len(level) for level in levels]
        self._register("_constant", constant[order].to(dtype))
        self._register("_sine", sine[order].to(dtype))
        self._register("_versine", versine[order].to(dtype))
        self._register("_joint_of_link", torch.tensor([joint_of_link[link] for link in order]))
        self._register("_unsort", torch.tensor([order.index(link) for link in range(n_link)]))
        self._register("_child_of_joint", torch.tensor(child_of_joint))
        self._register("_axes", axes.to(dtype))
        self._register("upstream", upstream)
        for depth, above in enumerate(parents):
            self._register(f"_parents_{depth}", torch.tensor(above))

    def _register(self, name: str, tensor: Tensor) -> None:
        self.register_buffer(name, tensor, persistent=False)  # made from the description, never learned

    @property
    def dtype(self) -> torch.dtype:
        """Of the buffers, and so of the ``q`` that :meth:`forward` takes."""
        return self._constant.dtype

    def link_index(self, name: str) -> int:
        """Place of a link in ``link_names``.

        Raises:
            UnknownNameError: there is no such link; the message lists all.
        """
        if name not in self.link_names:
            raise UnknownNameError("link", name, self.link_names)
        return self.link_names.index(name)

    def forward(self, q: Float[Tensor, "*batch n_q"]) -> LinkPoses:
        """Poses of all links at joint angles ``q`` [rad].

        Finiteness is not checked here (it would stop ``vmap``): a NaN angle gives NaN poses.

        Raises:
            ShapeError: the last dimension is not ``n_q``; the message lists the joints in order.
            ParameterError: ``q`` has another dtype than this module.
        """
        self._check(q)
        angle = q[..., self._joint_of_link, None, None]
        # versine as 2 sin^2(q/2): 1 - cos q loses half its digits near 0
        local = self._constant + torch.sin(angle) * self._sine
        local = local + 2 * torch.sin(angle / 2) ** 2 * self._versine
        levels = list(local.split(self._sizes, dim=-3))
        for depth in range(1, len(levels)):
            above = levels[depth - 1][..., getattr(self, f"_parents_{depth}"), :, :]
            levels[depth] = above @ levels[depth]
        transforms = torch.cat(levels, dim=-3)[..., self._unsort, :, :]
        return LinkPoses(transforms, self.link_names)

    def joint_axes(
        self, poses_or_q: LinkPoses | Float[Tensor, "*batch n_q"]
    ) -> tuple[Float[Tensor, "*batch n_q 3"], Float[Tensor, "*batch n_q 3"]]:
        """``z_j = R_j e_j`` and a point ``o_j`` [m] on it, of every joint, in the hand frame."""
        poses = poses_or_q if isinstance(poses_or_q, LinkPoses) else self(poses_or_q)
        child = poses.transforms[..., self._child_of_joint, :, :]
        axis = (child[..., :3, :3] @ self._axes[..., None])[..., 0]
        return axis, child[..., :3, 3]

    def jacobian(
        self,
        q: LinkPoses | Float[Tensor, "*batch n_q"],
        link: str | int,
        point: Float[Tensor, "*batch 3"] | None = None,
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
            if point.shape[-1:] != (3,):
                raise ShapeError("point", "(*batch, 3)", point.shape, "it is a point in the link's frame")
            x = x + (T[..., :3, :3] @ point[..., None])[..., 0]
        axis, origin = self.joint_axes(poses)
        v = torch.linalg.cross(axis, x[..., None, :] - origin)
        moves = self.upstream[k][:, None]
        return (torch.cat([v, axis.expand_as(v)], dim=-1) * moves).mT

    def _check(self, q: Tensor) -> None:
        n_q = len(self.joint_names)
        if q.dim() == 0 or q.shape[-1] != n_q:
            joints = ", ".join(self.joint_names)
            raise ShapeError("q", f"(*batch, {n_q})", q.shape, f"the joints are, in order: {joints}")
        if q.dtype != self.dtype:
            valid = f"{self.dtype}, the dtype of this module (change it with .to())"
            raise ParameterError("q.dtype", q.dtype, valid)

    def extra_repr(self) -> str:
        return f"'{self.hand.name}', links={len(self.link_names)}, joints={len(self.joint_names)}"
