"""What an MJCF has besides the hand: things to take hold of."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .._extras import require


def things(model: Any, bodies: Iterable[int]) -> set[int]:
    """Bodies that move on the world and that nothing drives, with all that they carry.

    Where there is neither actuator nor tendon nor equality: those that float and carry no joint.

    Args:
        model: MuJoCo's.
        bodies: their numbers, those that carry others first.
    """
    kinds: dict[int, list[int]] = {}
    for joint, body in zip(model.jnt_type, model.jnt_bodyid, strict=True):
        kinds.setdefault(int(model.body_rootid[body]), []).append(int(joint))
    driven = _driven(model)
    if driven:
        found = kinds.keys() - driven
    else:
        free = int(require("mujoco").mjtJoint.mjJNT_FREE)
        found = {root for root, joints in kinds.items() if joints == [free]}
    return {body for body in bodies if int(model.body_rootid[body]) in found}


def _driven(model: Any) -> set[int]:
    """Bodies on the world of which an actuator, a tendon or an equality of joints moves a part."""
    mj = require("mujoco")
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    dofs = {*data.moment_colind.tolist(), *model.ten_J_colind.tolist()}
    for kind, *ends in zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True):
        dofs |= {int(model.jnt_dofadr[j]) for j in ends if kind == mj.mjtEq.mjEQ_JOINT and j >= 0}
    return {int(model.body_rootid[model.dof_bodyid[dof]]) for dof in dofs}
