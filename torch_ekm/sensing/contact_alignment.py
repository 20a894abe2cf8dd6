from __future__ import annotations

import dataclasses
import math

import torch

from .._noise import NOISE
from .._warnings import warn
from ..contact.contacts import contact_kinematics
from ..contact.detector import ContactDetector
from ..description import HandDescription, ObjectDescription
from ..estimation.filters import update
from ..kinematics import HandKinematics
from ..plant import Observation, Plant, PlantWrapper
from ..typing import Float, Tensor

_LASTING_STD = math.radians(5.0)  # a joint that is less certain is known by a cable alone; its error lasts
_CHANGE = 0.2  # share of its deviation by which such an error changes between two observations
_GATE = 3.0  # deviations of a gap, up to which a pad of a hand without fingertip sensors is in contact
_ITERATIONS = 4
_OPEN, _FAR = 7e-4, 1e-2  # [m]: gaps of a pad that measures force at which a joint's sensor may be wrong
_ALIKE = 3.0  # nats: such joints are not distinguishable


class ContactAligned(PlantWrapper):
    r"""``min_q (q - q_seen)^T P^-1 (q - q_seen) + sum_i (gap_i(q) / s_g)^2`` over pads i in contact.

    Encoders alone give the angle of a joint without a Hall sensor, through a tendon with another
    pulley radius than the model's that stretches under load: on the iCub the thumb's opposition is
    off by 10 deg, the thumb then seems to be millimetres away from the object that it presses, and no
    kinematic model can be made of the grasp. But where a pad is in contact, the gap is known. It is where it
    measures 0.5 N or, on a hand without fingertip sensors, where its gap is within three deviations. Each
    joint takes as much of what is missing as its deviation allows.

    What a joint known to 5 deg or worse took at the last observation is expected again, with the deviation
    that the gaps left it and a fifth of its own: where a joint moves its pad along the object, two angles
    explain the same gap.

    A pad that measures force and stays 0.7 to 10 mm away, since the joint that is to close the gap stands at
    its stop, says that the sensor of another one is wrong, such as one that died after its calibration: the
    one, known to 30 deg from then on, without which all gaps and encoders are likeliest. A warning names it;
    the next grasp uses it again.

    P is ``info["estimate"]["joint_covariance"]`` [rad^2] where the plant states it, else 0.5 deg for joints
    with a Hall sensor and 10 deg for others. Solved by Gauss-Newton, at every observation, within the joints'
    ranges.

    Args:
        plant: gives estimates of joints, pose and fingertip forces.
        hand, obj: what it consists of.
    """

    def __init__(self, plant: Plant, hand: HandDescription, obj: ObjectDescription) -> None:
        super().__init__(plant)
        self.hand = hand
        self._detector = ContactDetector(hand, obj, margin=math.inf)
        self._kinematics = HandKinematics(hand)
        self._range = hand.joint_lower, hand.joint_upper
        sensed = {sensor.joint for sensor in hand.hall_sensors}
        std = [NOISE.joint if name in sensed else NOISE.unsensed_joint for name in hand.joint_names]
        moves = torch.from_numpy(hand.joint_upper > hand.joint_lower)
        self._last: tuple[Float[Tensor, " n_q"], Float[Tensor, " n_q"]] | None = None
        """What each joint took at the last observation [rad], and the variance that is left [rad^2]."""
        self._covariance = torch.diag(torch.tensor(std, dtype=torch.float64) ** 2 * moves)
        self._wrong: set[int] = set()
        """Joints whose sensors are wrong in this grasp."""
        self._named: set[int] = set()

    def reset(self, seed: int) -> Observation:
        """A new grasp, of which nothing is known."""
        self._last, self._wrong = None, set()
        return super().reset(seed)

    def observation(self, seen: Observation) -> Observation:
        """``seen`` with joints that agree with the contacts."""
        P = seen.info.get("estimate", {}).get("joint_covariance", self._covariance)
        P = _without_sensors(P, self._wrong)
        expected = seen.q
        if self._last is not None:
            took, left = self._last
            own = P.diagonal()
            lasts = own.sqrt() > _LASTING_STD
            share = torch.where(lasts, left / own + _CHANGE**2, 1.0).clamp(max=1.0).sqrt()
            P, expected = share[:, None] * P * share, seen.q + took * lasts
        pads = self._touching(seen, expected, P)
        q, left, gap = self._aligned(seen, expected, P, pads)
        if seen.fingertip_force is not None and bool((gap.abs() > _OPEN).any()):
            wrong = self._doubted(seen, expected, P, pads, gap)
            if wrong is not None:
                q, left, _ = self._aligned(seen, expected, _without_sensors(P, {wrong}), pads)
                self._wrong.add(wrong)
        self._last = q - seen.q, left
        return dataclasses.replace(seen, q=q)

    def _aligned(
        self, seen: Observation, expected: Float[Tensor, " n_q"], P: Float[Tensor, "n_q n_q"], pads: list[str]
    ) -> tuple[Float[Tensor, " n_q"], Float[Tensor, " n_q"], Float[Tensor, " n"]]:
        """Joints, the variance that the gaps leave them [rad^2], and the gaps that stay [m]."""
        q, left, gap = expected, P, P.new_zeros(0)
        for _ in range(_ITERATIONS if pads else 0):
            before, (gap, H) = q, self._gaps(seen, q, pads)
            R = gap.new_full(gap.shape, NOISE.gap**2)
            q, left = map(torch.from_numpy, update(expected, P, -gap, H, R, at=q, bounds=self._range))
            gap = gap + H @ (q - before)
        return q, left.diagonal(), gap

    def _doubted(
        self,
        seen: Observation,
        expected: Float[Tensor, " n_q"],
        P: Float[Tensor, "n_q n_q"],
        pads: list[str],
        gap: Float[Tensor, " n"],
    ) -> int | None:
        """One more joint whose sensor is wrong, by gaps that stay open."""
        at, H = self._gaps(seen, expected, pads)
        at_q = expected.numpy()
        J_a = torch.from_numpy(self.hand.lengths.jacobian(at_q, self.hand.actuation_jacobian))
        way = seen.a - torch.from_numpy(self.hand.actuator_offset)
        M = torch.cat([H, J_a])
        differs = torch.cat([-at, seen.a - torch.from_numpy(self.hand.unloaded(at_q))])
        R = torch.cat([torch.full_like(at, NOISE.gap**2), NOISE.encoder**2 + (NOISE.arm * way) ** 2])
        for pad in ((gap.abs() > _OPEN) & (at.abs() < _FAR)).nonzero().flatten().tolist():
            likely: dict[int, float] = {}
            for joint in (H[pad] * (P.diagonal() < _LASTING_STD**2)).nonzero().flatten().tolist():
                without = _without_sensors(P, {joint})
                if abs(float(self._aligned(seen, expected, without, pads)[2][pad])) <= _OPEN:
                    S = M @ without @ M.mT + torch.diag(R)
                    likely[joint] = -0.5 * float(differs @ torch.linalg.solve(S, differs) + torch.logdet(S))
            if likely:
                most = max(likely, key=lambda joint: likely[joint])
                if most not in self._named:
                    self._named.add(most)
                    alike = [j for j in likely if likely[j] > likely[most] - _ALIKE]
                    names = " or ".join(f"'{self.hand.joint_names[j]}'" for j in alike)
                    warn(
                        f"the sensor of joint {names} contradicts pad '{pads[pad]}', which presses; until "
                        "the next grasp contacts alone say where the joint is: check the sensor"
                    )
                return most
        return None

    def _touching(
        self, seen: Observation, q: Float[Tensor, " n_q"], P: Float[Tensor, "n_q n_q"]
    ) -> list[str]:
        """Pads that are in contact: by their force, or else by a gap that the joints' deviations explain."""
        names = [pad.name for pad in self.hand.pads]
        if seen.fingertip_force is not None:
            touch = seen.fingertip_force >= NOISE.pressing
        else:
            gap, H = self._gaps(seen, q, names)
            touch = gap.abs() < _GATE * ((H @ P * H).sum(-1) + NOISE.gap**2).sqrt()
        return [name for name, touches in zip(names, touch.tolist(), strict=True) if touches]

    def _gaps(
        self, seen: Observation, q: Float[Tensor, " n_q"], pads: list[str]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n n_q"]]:
        """Gaps of pads [m] and ``d gap_i / dq = n_i^T J_v,i`` [m/rad]."""
        contacts = self._detector(q, seen.position, seen.rotation)
        contacts = contacts.select([contacts.finger.index(pad) for pad in pads])
        links = [self._kinematics.link_index(link) for link in contacts.link]
        axes, upstream = self._kinematics.joint_axes(q), self._kinematics.upstream[links]
        kin = contact_kinematics(contacts, seen.position, *axes, upstream, rolling=False)
        return contacts.gap, (contacts.normal[:, None] @ kin.point_jacobian)[:, 0]


def _without_sensors(P: Float[Tensor, "n_q n_q"], joints: set[int]) -> Float[Tensor, "n_q n_q"]:
    """P with some joints known to 30 deg only."""
    wrong = P.new_zeros(len(P))
    wrong[list(joints)] = NOISE.wrong_joint**2
    return P + torch.diag(wrong)
