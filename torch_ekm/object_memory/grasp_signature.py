from __future__ import annotations

from collections.abc import Sequence

import torch

from .._checks import check_finite, check_positive
from ..description import HandDescription
from ..exceptions import ParameterError, ShapeError, UnknownNameError
from ..kinematics import HandKinematics
from ..kinematics.null_space import null_space
from ..typing import Float, Tensor


class GraspSignature:
    r"""``z = [w / s_w;  N^T K_s (q - q0) / s_m;  f_n / s_f]``: width, weight and load of a grasp.

    * w: distance between the thumb's pad and the line through the outer fingers' pads, less their radii:
      how wide the object is, wherever it is grasped.
    * ``N = null([J_a; C])`` of each finger: how the joints of one tendon share its motion. The tendon has
      no say in that, only the contact does: ``N^T (K_s (q - q0) + J_h^T f) = 0``, so an underactuated
      finger weighs what it holds.
    * f_n: normal force of each pad.

    Needs no object, no camera and no label: joint angles, encoders, fingertip forces and the hand's own
    description. What a wrong spring or pulley makes of it is the same at each grasp.

    Args:
        hand: the hand.
        thumb, fingers: names of the pads that oppose each other.
        from_encoders: joints whose angle is taken from the actuators' encoders instead of ``q``: those
            without a sensor, if ``q`` holds something for them that was made with the object's shape.
        width_scatter, load_scatter, force_scatter: what is expected to differ between two grasps of one
            object: [m], [N m], [N]. On the iCub hand with 0.3 deg of joint noise, the mean of eight
            readings of a grasp drawn within 10 mm and 5 deg differs by about this much.

    Raises:
        UnknownNameError: no such pad or joint; the message lists them.
        ParameterError: no finger opposes the thumb, or a scatter is not positive.
    """

    def __init__(
        self,
        hand: HandDescription,
        thumb: str,
        fingers: Sequence[str],
        *,
        from_encoders: Sequence[str] = (),
        width_scatter: float = 0.3e-3,
        load_scatter: float = 1.5e-3,
        force_scatter: float = 0.06,
    ) -> None:
        by_name = {pad.name: i for i, pad in enumerate(hand.pads)}
        for name in (thumb, *fingers):
            if name not in by_name:
                raise UnknownNameError("contact pad", name, by_name)
        if not fingers or thumb in fingers:
            raise ParameterError("fingers", tuple(fingers), f"one or more pads that oppose '{thumb}'")
        for name in from_encoders:
            if name not in hand.joint_names:
                raise UnknownNameError("joint", name, hand.joint_names)
        width = check_positive("width_scatter", width_scatter)
        load = check_positive("load_scatter", load_scatter)
        force = check_positive("force_scatter", force_scatter)
        self.hand, self.kinematics = hand, HandKinematics(hand)
        self._pads = [by_name[name] for name in (thumb, *fingers)]
        pads = [hand.pads[i] for i in self._pads]
        self._links = [self.kinematics.link_index(pad.link) for pad in pads]
        self._ends = torch.tensor([[*pad.end, 1.0] for pad in pads], dtype=torch.float64)
        self._radii = pads[0].radius + (pads[1].radius + pads[-1].radius) / 2
        J_a, C = torch.from_numpy(hand.actuation_jacobian.copy()), torch.from_numpy(hand.coupling.copy())
        self._fixed = torch.cat([J_a, C.reshape(-1, hand.n_q)])  # what motors and couplings decide
        free = torch.from_numpy(hand.joint_upper > hand.joint_lower)
        upstream = self.kinematics.upstream[self._links].bool() & free
        self._passive = torch.cat([_null(self._fixed, moved) for moved in upstream], dim=1)
        self._stiffness = torch.from_numpy(hand.spring_stiffness.copy())
        self._rest = torch.from_numpy(hand.spring_rest.copy())
        self._offset = torch.from_numpy(hand.actuator_offset)
        self._blind = [hand.joint_names.index(name) for name in from_encoders]
        n = self._passive.shape[1]
        self._scatter = torch.tensor([width, *[load] * n, *[force] * len(pads)], dtype=torch.float64)

    @property
    def n_features(self) -> int:
        """d: one width, one load per passive direction, one force per pad."""
        return len(self._scatter)

    def __call__(
        self,
        q: Float[Tensor, "*batch n_q"],
        a: Float[Tensor, "*batch n_a"],
        fingertip_force: Float[Tensor, "*batch n_pads"] | None,
    ) -> Float[Tensor, "*batch d"]:
        """Signature of one reading; the mean over several readings at rest has less of the sensors' noise.

        Args:
            q: joint angles [rad].
            a: encoders [rad].
            fingertip_force: normal force of each of the hand's pads [N].

        Raises:
            ParameterError: no forces: the signature is made of them.
            ShapeError, NonFiniteError: readings that cannot be right.
        """
        hand = self.hand
        if fingertip_force is None:
            raise ParameterError("fingertip_force", None, "measured: no signature without sensors")
        sizes = {"q": (q, hand.n_q), "a": (a, hand.n_a), "fingertip_force": (fingertip_force, len(hand.pads))}
        for name, (value, size) in sizes.items():
            if value.shape != (*q.shape[:-1], size):
                raise ShapeError(name, f"(*batch, {size})", value.shape)
            check_finite(name, value)
        q = self._seen_by_encoders(q, a) if self._blind else q
        load = (self._stiffness * (q - self._rest)) @ self._passive
        features = [self._width(q)[..., None], load, fingertip_force[..., self._pads]]
        return torch.cat(features, dim=-1) / self._scatter

    def _width(self, q: Tensor) -> Tensor:
        poses = self.kinematics(q).transforms[..., self._links, :, :]
        end = (poses @ self._ends[..., None])[..., :3, 0]
        first, last = end[..., 1, :], end[..., -1, :]
        across = end[..., 0, :] - (first + last) / 2
        if len(self._links) > 2:
            line = torch.nn.functional.normalize(last - first, dim=-1)
            across = across - line * (across * line).sum(-1, keepdim=True)
        return torch.linalg.vector_norm(across, dim=-1) - self._radii

    def _seen_by_encoders(self, q: Tensor, a: Tensor) -> Tensor:
        """Least ``|[J_a; C] q - [a - a_0; 0]|`` over the joints without a sensor."""
        known = q.clone()
        known[..., self._blind] = 0.0
        wanted = torch.cat([a - self._offset, q.new_zeros(*q.shape[:-1], len(self._fixed) - a.shape[-1])], -1)
        missing = wanted - known @ self._fixed.mT
        known[..., self._blind] = missing @ torch.linalg.pinv(self._fixed[:, self._blind]).mT
        return known


def _null(rows: Tensor, moved: Tensor) -> Float[Tensor, "n_q k"]:
    """Orthonormal motions of the ``moved`` joints that no row sees; the last joint bends."""
    at = torch.nonzero(moved).flatten()
    free = null_space(rows[:, at])
    out = rows.new_zeros(rows.shape[1], free.shape[1])
    out[at] = free * torch.sign(free[-1:] + 1e-12)
    return out
