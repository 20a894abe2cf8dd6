"""What a movement teaches: forces, figures of the hand, g."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

from ..plant import Observation
from ..residual import UpdateReport
from ..typing import Float, Tensor
from .decision import Expectation

if TYPE_CHECKING:
    from ..description import HandDescription
    from ..estimation.hand_figures import DescribedFigures, HandFigures
    from .controller import LookAndMoveController
    from .knowledge import HandKnowledge

_NOISE, _OF_IT, _SURPRISES = (
    0.5,
    0.25,
    1.6,
)  # [N]; share of what a finger bears; deviations that are a surprise


class ForceSurprise(NamedTuple):
    """What the pads in contact measured after a movement, against the prediction."""

    pads: tuple[int, ...]
    change: Float[Tensor, " n_c"]
    """Of what they read [N]; NaN where a pad does not measure, or has let go."""
    surprise: Float[Tensor, " n_c"]
    """Measured less predicted [N]; NaN likewise."""
    gone: Tensor
    """Which pads measured before the movement, and do not now ``(n_c,)``."""

    def wrong(self, before: Observation) -> bool:
        """Some pad measured what was not predicted, or has let go."""
        assert before.fingertip_force is not None
        noise = (_NOISE**2 + (_OF_IT * before.fingertip_force[list(self.pads)]).square()).sqrt()
        return bool((self.surprise.abs() > _SURPRISES * noise).any() or self.gone.any())


def felt(
    hand: HandDescription, least: float, expected: Expectation, before: Observation, after: Observation
) -> ForceSurprise | None:
    """Of a movement; None: no pad measures.

    Args:
        least: a pad that reads less may be dead [N].
    """
    if before.fingertip_force is None or after.fingertip_force is None or expected.normal is None:
        return None
    _, pads = hand.pad_rows(expected.pieces[0].linearization.contacts.finger)
    was, now = before.fingertip_force[pads], after.fingertip_force[pads]
    touched, touches = was >= least, now >= least
    surprise = (now - expected.normal[pads]).where(touched & touches, torch.nan)
    return ForceSurprise(
        tuple(pads), (now - was).where(touched & touches, torch.nan), surprise, touched & ~touches
    )


def learn_forces(
    hand: HandDescription, knowledge: HandKnowledge, expected: Expectation, felt: ForceSurprise
) -> None:
    """Pads that touched and measured before and after a movement teach how their forces answer."""
    change = torch.full_like(knowledge.forces.drift, torch.nan)
    change[list(felt.pads)] = felt.change
    described, names = (
        torch.zeros_like(knowledge.forces.correction),
        expected.pieces[0].linearization.contacts.finger,
    )
    rows, _ = hand.pad_rows(names)
    way = torch.stack([one.action.norm() for one in expected.pieces])
    for one, share in zip(expected.pieces, (way / way.sum().clamp(min=1e-12)).tolist(), strict=True):
        lin = one.linearization
        if lin.contacts.finger == names:
            described[list(felt.pads)] += share * lin.described_normal_sensitivity[rows]
    knowledge.forces.update(expected.moved, change, described)


def learn(
    controller: LookAndMoveController,
    figures: HandFigures | DescribedFigures,
    expected: Expectation,
    moved: Float[Tensor, " n_a"],
    increment: Float[Tensor, " n_s"],
) -> UpdateReport | None:
    """Figures and g learn from a movement: g from its pieces one by one, each with its share of what was not
    predicted.

    Args:
        moved: by the encoders [rad].
        increment: ds, as measured.
    """
    enhanced, model, report = controller.enhanced, controller.kinematic, None
    if enhanced is None:
        return None
    off = increment - expected.nominal
    path = [(one.linearization, one.action) for one in expected.pieces]
    figures.learn_path(path, moved, off, expected.nominal)
    rest = increment - expected.increment
    way = torch.stack([one.action.norm() for one in expected.pieces])
    done, shares = 0.0, (way / way.sum().clamp(min=1e-12)).tolist()
    for one, share in zip(expected.pieces, shares, strict=True):
        lin = one.linearization
        nominal = one.nominal + model.followed(lin).step(one.action) - lin.step(one.action)
        state = one.state if done == 0 else one.state.plus(done * rest)
        report = enhanced.update(state, one.action, one.increment + share * rest, nominal)
        done += share
    return report
