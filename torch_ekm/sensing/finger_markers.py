"""Joint angles from markers on the fingers: where they sit, where the camera is, and then the angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from .._extras import require
from ..description import HandDescription
from ..exceptions import CalibrationError, ParameterError, ShapeError
from ..kinematics import HandKinematics
from ..kinematics.null_space import null_space
from ..kinematics.se3 import exp
from ..kinematics.tensors import as_tensors
from ..typing import Array, Float, Tensor
from .joint_estimator import COUPLING_STD, JointEstimate

_LOOSE_ANGLE, _LOOSE_OFFSET = 10.0, 0.1  # [rad], [m]: they keep the normal matrix regular and weigh nothing
_UNKNOWN = 0.01  # [m]: a marker whose place is no better known is not calibrated


@dataclass(frozen=True)
class FingerMarkers:
    """``y_m = R x_m(q) + t``, ``x_m`` the point ``offset_m`` of the marker's link: calibrated markers.

    A planar hand is seen in two coordinates, axes turning from the first to the second as joints do about
    ``planar_normal``.
    """

    hand: HandDescription
    link: tuple[str, ...]
    """Of each marker."""
    offset: Float[Tensor, "n_m 3"]
    """In the link's frame [m]; in a planar hand in its plane."""
    offset_std: Float[Tensor, " n_m"]
    """Standard error, the largest over directions [m]."""
    rotation: Float[Tensor, "3 3"]
    """R, hand axes to the camera's."""
    translation: Float[Tensor, " 3"]
    """t [m]."""
    registration_std: Float[Tensor, " 2"]
    """Standard errors of R [rad] and t [m], the largest over directions."""
    noise: float
    """Standard deviation of a marker's coordinate that the fit shows [m]; far above ``marker_std``: links,
    couplings or the two axes of a planar picture are not as said."""
    marker_std: float
    """What was assumed for it [m]."""

    def joints(self, seen: Float[Tensor, "*batch n_m d"], iterations: int = 20) -> JointEstimate:
        """``min_q sum_m |R x_m(q) + t - y_m|^2 / sigma^2 + |(q - middle)/spread|^2`` by Gauss-Newton.

        A weak prior, uniform over each joint's range, stands in where markers are missing, and the covariance
        says so. It counts the noise of the markers, not the calibration's errors, which all frames share.

        Args:
            seen: d = 3, or 2 for a planar hand [m]; NaN: not seen.
            iterations: all frames take as many.

        Raises:
            ShapeError: not as many markers or coordinates as were calibrated.
        """
        (seen,) = as_tensors(seen=seen)
        view = _View(self.hand, self.link)
        flat = view.checked(seen)
        visible = torch.isfinite(flat)
        weight = visible.to(flat.dtype) / self.marker_std**2
        middle, spread, rest, C = _joint_prior(self.hand)
        fixed = torch.diag(spread**-2) + C.mT @ C / COUPLING_STD**2
        q = middle.expand(len(flat), -1)
        for _ in range(iterations):
            x, J_q, _ = view.points(q, self.offset)
            J = (self.rotation @ J_q)[..., : view.d, :].flatten(1, 2)
            miss = (flat - (x @ self.rotation.mT + self.translation)[..., : view.d]).nan_to_num().flatten(1)
            J_w = (weight.flatten(1)[..., None] * J).mT
            information = J_w @ J + fixed
            coupled = (rest - q) @ C.mT @ C / COUPLING_STD**2
            right = (J_w @ miss[..., None])[..., 0] + (middle - q) / spread**2 + coupled
            q = q + torch.linalg.solve(information, right).clamp(-0.5, 0.5)
        covariance = torch.linalg.inv(information)
        return JointEstimate(*(x.reshape(*seen.shape[:-2], *x.shape[1:]) for x in (q, covariance)))

    def registered(self, seen: Float[Tensor, "n_f n_m d"]) -> FingerMarkers:
        """The same markers, the camera elsewhere: R and t from frames of another recording."""
        return calibrate_markers(
            self.hand,
            self.link,
            seen,
            offset=self.offset,
            offset_std=self.offset_std.clamp_min(1e-6),
            marker_std=self.marker_std,
        )


class _View:
    """Marker points as functions of joint angles, and what of them is seen."""

    def __init__(self, hand: HandDescription, link: Sequence[str]) -> None:
        self.kinematics, self.n_q = HandKinematics(hand), hand.n_q
        self.index = [self.kinematics.link_index(name) for name in link]
        normal = hand.planar_normal
        self.d = 3 if normal is None else 2
        # axes of what is seen, in the hand frame: rows; a planar hand is seen along its normal
        self.axes = torch.eye(3, dtype=torch.float64)
        if normal is not None:
            n = torch.tensor(normal, dtype=torch.float64)
            n = n / n.norm()
            u = null_space(n[None])[:, 0]
            self.axes = torch.stack([u, torch.linalg.cross(n, u), n])
        at_zero = self.kinematics(torch.zeros(hand.n_q, dtype=torch.float64)).transforms[self.index]
        # directions in the links' frames in which an offset is sought
        self.free = at_zero[:, :3, :3].mT @ self.axes[: self.d].mT

    def checked(self, seen: Tensor) -> Float[Tensor, "n_f n_m d"]:
        expected = (len(self.index), self.d)
        if seen.shape[-2:] != expected:
            raise ShapeError("seen", f"(*batch, {expected[0]}, {expected[1]})", seen.shape)
        return seen.to(torch.float64).reshape(-1, *expected)

    def points(self, q: Tensor, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``x_m`` [m], ``dx_m/dq`` and the rotations of the links, hand frame."""
        poses = self.kinematics(q)
        T = poses.transforms[..., self.index, :, :]
        x = T[..., :3, 3] + (T[..., :3, :3] @ offset[..., None])[..., 0]
        J = [self.kinematics.jacobian(poses, k, offset[m])[..., :3, :] for m, k in enumerate(self.index)]
        return x, torch.stack(J, dim=-3), T[..., :3, :3]


def _joint_prior(hand: HandDescription) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Middle and standard deviation of the joints' ranges; q0 and C of the couplings ``C q = C q0``."""
    given = (hand.joint_lower, hand.joint_upper, hand.spring_rest, hand.coupling)
    lower, upper, rest, C = (torch.from_numpy(x.copy()) for x in given)
    lower, upper = lower.clamp(min=-math.pi), upper.clamp(max=math.pi)
    return (lower + upper) / 2, (upper - lower).clamp(min=1e-3) / math.sqrt(12), rest, C


def calibrate_markers(
    hand: HandDescription,
    link: Sequence[str],
    seen: Float[Tensor, "n_f n_m d"],
    *,
    q: Float[Tensor, "n_f n_q"] | None = None,
    q_std: float = 0.01,
    offset: Float[Tensor, "n_m 3"] | None = None,
    offset_std: float | Float[Tensor, " n_m"] = _LOOSE_OFFSET,
    marker_std: float = 5e-4,
) -> FingerMarkers:
    """Offsets of all markers, one registration R, t and the angles of every frame, by least squares.

    ```
    min  sum |R x_m(q_f) + t - y_fm|^2 / sigma^2 + sum |(q_f - known) / q_std|^2
       + sum |(offset - given) / offset_std|^2
    ```

    Markers alone cannot tell the zero of a fingertip's joint from the place of the marker beyond it: give
    the angles of some frames (a joint at its stop, an encoder), or offsets from the drawing.

    Args:
        hand: links and joints.
        link: of each marker.
        seen: markers in several postures [m], d = 3, or 2 for a planar hand; NaN: not seen.
        q: known joint angles [rad], NaN where not known.
        q_std: how well.
        offset: where the markers are thought to sit, in their links' frames [m].
        offset_std: how well that is known [m].
        marker_std: noise of a marker's coordinate [m].

    Raises:
        CalibrationError: the place of a marker stays unknown; the message names it.
        ParameterError: a standard deviation is not positive.
        ShapeError, UnknownNameError: markers, links or angles that do not fit.
    """
    optimize = require("scipy.optimize")
    view, n_m = _View(hand, link), len(link)
    (seen,) = as_tensors(seen=seen)
    Y = view.checked(seen)
    n_f, n_q, d = len(Y), hand.n_q, view.d
    visible = torch.isfinite(Y)
    middle, _, rest, C = _joint_prior(hand)
    (known,) = as_tensors(q=torch.full((n_f, n_q), math.nan, dtype=torch.float64) if q is None else q)
    if known.shape != (n_f, n_q):
        raise ShapeError("q", f"({n_f}, {n_q}), an angle for each frame and joint or NaN", known.shape)
    p0 = torch.zeros(n_m, 3, dtype=torch.float64) if offset is None else as_tensors(offset=offset)[0]
    (spread,) = as_tensors(offset_std=offset_std)
    for name, value in (("q_std", q_std), ("marker_std", marker_std), ("offset_std", float(spread.min()))):
        if not value > 0:
            raise ParameterError(name, value, "positive")
    is_known = torch.isfinite(known)
    q0 = torch.where(is_known, known.nan_to_num(), middle)
    q_scale = torch.where(is_known, q_std, _LOOSE_ANGLE)
    turns = [0, 1, 2] if d == 3 else [2]
    ends = np.cumsum([n_f * n_q, d * n_m, len(turns), d])
    # known angles, known offsets (0 from where they are thought to be) and couplings: rows of one matrix
    prior = np.zeros((ends[1] + n_f * len(C), ends[3]))
    sharp = 1 / spread.reshape(-1, 1).expand(n_m, d)
    np.fill_diagonal(prior, torch.cat([1 / q_scale.flatten(), sharp.flatten()]).numpy())
    prior[ends[1] :, : ends[0]] = np.kron(np.eye(n_f), C.numpy()) / COUPLING_STD
    wish = torch.cat([(q0 / q_scale).flatten(), torch.zeros(d * n_m), (C @ rest / COUPLING_STD).repeat(n_f)])
    wish = wish.numpy()

    def unpack(v: Array) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        angles, place, turn, t = (torch.from_numpy(part.copy()) for part in np.split(v, ends[:-1]))
        phi = torch.zeros(3, dtype=torch.float64)
        phi[turns] = turn
        p = p0 + (view.free @ place.reshape(n_m, d, 1))[..., 0]
        return angles.reshape(n_f, n_q), p, phi, t

    def residual(v: Array) -> Array:
        angles, p, phi, t = unpack(v)
        x, _, _ = view.points(angles, p)
        miss = (x @ view.axes.mT @ start.mT @ exp(phi).mT)[..., :d] + t - Y
        return np.concatenate([(miss[visible] / marker_std).numpy(), prior @ v - wish])

    def jacobian(v: Array) -> Array:
        angles, p, phi, _ = unpack(v)
        x, J_q, R_link = view.points(angles, p)
        R = exp(phi) @ start @ view.axes
        dR = torch.func.jacfwd(exp)(phi)[..., turns]
        J = torch.zeros(n_f, n_m, d, len(v), dtype=torch.float64)
        for f in range(n_f):
            J[f, :, :, f * n_q : (f + 1) * n_q] = (R @ J_q[f])[:, :d]
        for m in range(n_m):
            J[:, m, :, ends[0] + d * m : ends[0] + d * (m + 1)] = (R @ R_link[:, m] @ view.free[m])[:, :d]
        J[..., ends[1] : ends[2]] = torch.einsum("ijk,fmj->fmik", dR, x @ view.axes.mT @ start.mT)[:, :, :d]
        J[..., ends[2] :] = torch.eye(d, dtype=torch.float64)
        return np.concatenate([(J[visible] / marker_std).numpy(), prior])

    start = _first_turn(view, q0, p0, Y, visible)
    first = np.concatenate([q0.flatten().numpy(), np.zeros(ends[3] - ends[0])])
    x, _, _ = view.points(q0, p0)
    offset_of_all = torch.where(visible, Y - (x @ view.axes.mT @ start.mT)[..., :d], 0.0)
    first[ends[2] :] = (offset_of_all.sum((0, 1)) / visible.sum((0, 1)).clamp(min=1)).numpy()
    fit = optimize.least_squares(residual, first, jac=jacobian, x_scale="jac", method="trf", max_nfev=200)
    if not fit.success:
        raise CalibrationError("finger markers", f"no fit was found ({fit.message})")
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    std = np.sqrt(np.diag(covariance))
    offset_error = std[ends[0] : ends[1]].reshape(n_m, d).max(1)
    for m in range(n_m):
        if not offset_error[m] < _UNKNOWN:
            raise CalibrationError(
                f"marker {m} on '{link[m]}'",
                f"its place is known to {1e3 * offset_error[m]:.0f} mm only; give more postures, the joint "
                "angles of some frames, or offsets from the drawing",
            )
    _, p, phi, t = unpack(fit.x)
    n_seen = int(visible.sum())
    left, J = fit.fun[:n_seen], fit.jac[:n_seen]
    spare = n_seen - float(np.sum(J @ covariance * J))  # measurements beyond what the fit takes up
    full = torch.zeros(3, dtype=torch.float64)
    full[:d] = t
    return FingerMarkers(
        hand=hand,
        link=tuple(link),
        offset=p,
        offset_std=torch.from_numpy(offset_error),
        rotation=exp(phi) @ start @ view.axes,
        translation=full,
        registration_std=torch.tensor([std[ends[1] : ends[2]].max(), std[ends[2] :].max()]),
        noise=float(marker_std * np.sqrt(left @ left / max(spare, 1.0))),
        marker_std=marker_std,
    )


def _first_turn(view: _View, q: Tensor, p: Tensor, Y: Tensor, visible: Tensor) -> Float[Tensor, "3 3"]:
    """The rotation that lays the expected markers onto the seen ones best (Kabsch)."""
    whole = visible.all(-1)
    if int(whole.sum()) < view.d:
        raise CalibrationError("finger markers", f"only {int(whole.sum())} were seen at all")
    x, y = (view.points(q, p)[0] @ view.axes.mT)[whole][:, : view.d], Y[whole]
    H = (y - y.mean(0)).mT @ (x - x.mean(0))
    U, _, Vh = torch.linalg.svd(H)
    U[:, -1] = U[:, -1] * torch.linalg.det(U @ Vh).sign()
    turn = torch.eye(3, dtype=torch.float64)
    turn[: view.d, : view.d] = U @ Vh
    return turn
