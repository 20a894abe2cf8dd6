"""An E-KM of a grasped object, and copies of it."""

import copy
import math
import pickle
from types import SimpleNamespace

import pytest
import torch

from torch_ekm.control import DescribedFigures
from torch_ekm.description import load_hand
from torch_ekm.enhanced import EnhancedModel, GraspEncoding, grasp_learner
from torch_ekm.exceptions import ParameterError
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel
from torch_ekm.residual import SparseOnlineGP
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
F64 = torch.float64


class Held:
    """Whatever moves, it moves by ``J da``; thumb and index touch."""

    figures = DescribedFigures()

    def __init__(self) -> None:
        self.hand = load_hand("icub_right")
        self.kinematics = HandKinematics(self.hand)
        self.link_names = tuple(self.kinematics.link_names)
        generator = torch.Generator().manual_seed(0)
        self.J = 0.1 * torch.randn(self.hand.n_q + 6, self.hand.n_a, generator=generator, dtype=F64)

    def contacts(self, state: GraspState) -> SimpleNamespace:
        pads = {pad.name: pad.link for pad in self.hand.pads}
        return SimpleNamespace(link=(pads["thumb"], pads["index"]))

    def __call__(self, state: GraspState, delta_a: torch.Tensor) -> torch.Tensor:
        return delta_a @ self.J.mT


@pytest.fixture(scope="module")
def model() -> Held:
    return Held()


@pytest.fixture
def state(model: Held) -> GraspState:
    return GraspState(
        torch.full((model.hand.n_q,), 0.1, dtype=F64), torch.zeros(3, dtype=F64), torch.eye(3, dtype=F64)
    )


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("learner", [SparseOnlineGP, SparseOnlineGP(4, 6), "rbf", lambda n_s, n_a: None])
def test_a_learner_of_another_size_is_refused(model: Held, state: GraspState, learner) -> None:
    with pytest.raises(ParameterError, match="learner"):
        EnhancedModel.for_grasp(model, state, learner)


@pytest.mark.usefixtures("unchecked")
def test_arguments_in_the_wrong_order_are_refused(model: Held, state: GraspState) -> None:
    with pytest.raises(ParameterError, match="model"):
        EnhancedModel.for_grasp(state, model)
    with pytest.raises(ParameterError, match=r"observation\.state"):
        EnhancedModel.for_grasp(model, state).encode(state.q)


def test_it_sees_the_fingers_that_touch_and_knows_nothing_yet(model: Held, state: GraspState) -> None:
    ekm = EnhancedModel.for_grasp(model, state)
    joints = {model.hand.joint_names[j].split("_")[0] for j in ekm.encode.joints}
    assert joints == {"thumb", "index"}
    da = torch.full((model.hand.n_a,), 2 * DEG, dtype=F64)
    assert torch.equal(ekm(state, da), model(state, da))
    x = ekm.features(state, da)  # of the order of 1, and as wide as the learner
    torch.testing.assert_close(
        x, torch.cat([torch.zeros(len(ekm.encode.joints) + 6), torch.ones(9)]).double()
    )
    assert x.shape == (ekm.learner.in_features,)


def test_it_learns_the_objects_motion_in_mm_and_deg(model: Held, state: GraspState) -> None:
    ekm = EnhancedModel.for_grasp(model, state)
    da = torch.full((model.hand.n_a,), 2 * DEG, dtype=F64)
    missing = torch.zeros(model.hand.n_q + 6, dtype=F64)
    missing[-6:] = torch.tensor([1e-3, 0, 0, 0, 0, -1 * DEG])
    seen: list[torch.Tensor] = []
    learner, update = ekm.learner, ekm.learner.update
    learner.update = lambda x, y: seen.append(y) or update(x, y)  # type: ignore[method-assign]
    for _ in range(40):
        ekm.update(state, da, model(state, da) + missing)
    torch.testing.assert_close(seen[0], torch.tensor([1.0, 0, 0, 0, 0, -1.0], dtype=F64))
    torch.testing.assert_close(ekm(state, da), model(state, da) + missing, atol=0.1e-3, rtol=0)
    joints = slice(0, model.hand.n_q)
    assert torch.equal(ekm(state, da)[joints], model(state, da)[joints])


def test_learner_and_encoding_of_ones_own(model: Held, state: GraspState) -> None:
    sizes = []

    def factory(n_s: int, n_a: int) -> SparseOnlineGP:
        sizes.append((n_s, n_a))
        return grasp_learner(n_s, n_a, capacity=7)

    encode = GraspEncoding(state, [0, 1])
    ekm = EnhancedModel.for_grasp(model, state, factory, encode)
    assert sizes == [(8, model.hand.n_a)]
    assert ekm.encode is encode
    again = EnhancedModel.for_grasp(model, state, ekm.learner, encode)  # one that knows something already
    assert again.learner is ekm.learner


@pytest.mark.parametrize(
    "again", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copy", "pickle"]
)
def test_a_copy_predicts_the_same_and_learns_alone(again) -> None:
    plant = SimulatedHand("icub_right", "box")
    state = plant.reset(0).state
    plant.close()
    f = KinematicModel(plant.hand, plant.object)
    model, da = EnhancedModel.for_grasp(f, state), torch.full((plant.hand.n_a,), 0.02, dtype=torch.float64)
    model.update(state, da, 1.3 * f(state, da))
    other = again(model)
    before = model.predict(state, da)
    assert torch.equal(other.predict(state, da).mean, before.mean)
    assert torch.equal(again(f)(state, da), f(state, da))
    for _ in range(3):
        other.update(state, da, 0.5 * f(state, da))
    assert torch.equal(model.predict(state, da).mean, before.mean)
    assert not torch.equal(other.predict(state, da).mean, before.mean)
