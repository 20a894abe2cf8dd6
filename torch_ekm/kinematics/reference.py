"""The same forward kinematics through pytorch-kinematics: the reference that tests compare with.

This is the only place that touches pytorch-kinematics (0.10), because of its sharp edges: ``Chain`` is
no Module and ``.to()`` changes it in place; ``<mimic>`` is ignored; a tree has no Jacobian; one batch
dimension only; a wrong joint count fails with an opaque message; origins are built in float32 (1e-7 m).
``jacrev`` and second derivatives do not go through its analytical gradient, a custom
``autograd.Function`` (they do with ``analytical_grad=False``); ``vmap`` goes through neither.
"""

from __future__ import annotations

from pathlib import Path

import torch

from .._extras import require
from ..description import HandDescription
from ..exceptions import ShapeError
from ..typing import Float, Tensor


def reference_transforms(
    hand: HandDescription, q: Float[Tensor, "*batch n_q"]
) -> Float[Tensor, "*batch n_link 4 4"]:
    """``T_hand_link(q)`` of every link in the order of ``hand.link_names`` [m]; plain autograd.

    Parses the URDF at every call: for comparison, not for a loop.

    Raises:
        MissingExtraError: pytorch-kinematics is not installed.
        ShapeError: the last dimension of ``q`` is not the number of joints.
    """
    pk = require("pytorch_kinematics")
    if q.dim() == 0 or q.shape[-1] != hand.n_q:
        raise ShapeError("q", f"(*batch, {hand.n_q})", q.shape)
    text = Path(hand.urdf_path).read_bytes()
    chain = pk.build_chain_from_urdf(text).to(dtype=q.dtype, device=q.device)
    order = [hand.joint_names.index(name) for name in chain.get_joint_parameter_names()]
    flat = q.reshape(-1, hand.n_q)[:, order]
    frames = chain.forward_kinematics_tensor(flat, analytical_grad=False)
    names = [chain.idx_to_frame[k] for k in range(len(frames))]
    T = torch.stack([frames[names.index(name)] for name in hand.link_names], dim=-3)
    T = torch.linalg.inv(T[..., [hand.link_names.index(hand.base_link)], :, :]) @ T
    return T.reshape(*q.shape[:-1], len(hand.link_names), 4, 4)
