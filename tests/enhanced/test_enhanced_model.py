"""f + g for any callable f."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.func import jacrev

from torch_ekm.enhanced import EnhancedModel, GraspEncoding
from torch_ekm.exceptions import (
    NoDerivativeError,
    NonFiniteError,
    ParameterError,
    ShapeError,
    UnknownNameError,
)
from torch_ekm.kinematics.poses import GraspState
from torch_ekm.kinematics.se3 import exp
from torch_ekm.residual import MixtureResidual, RecursiveLeastSquares, ReplayMLP, SparseOnlineGP

N_S, N_A = 3, 2


def model(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """A wrong model of :func:`world`: somebody else's, and nonlinear."""
    return torch.stack([action[..., 0], action[..., 1] * state[..., 0].cos(), action.prod(-1)], dim=-1)


def world(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    gain = 1.3 + 0.3 * state[..., :1].sin()
    return model(state, action) * gain + 0.2 * action[..., :1]


def enhanced(**options) -> EnhancedModel:
    n_out = len(options.get("outputs") or range(3))
    learner = SparseOnlineGP(N_S + N_A, n_out, capacity=80, noise_variance=1e-4, parts=(), standardize=False)
    return EnhancedModel(model, learner, **options)


def sample(generator: torch.Generator, n: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    state = torch.rand(n, N_S, generator=generator, dtype=torch.float64)
    action = torch.randn(n, N_A, generator=generator, dtype=torch.float64)
    return state, action


def train(ekm: EnhancedModel, generator: torch.Generator, n: int = 300) -> EnhancedModel:
    for state, action in zip(*sample(generator, n), strict=True):
        ekm.update(state, action, world(state, action))
    return ekm


def test_correction_removes_most_of_the_error(generator: torch.Generator) -> None:
    ekm = train(enhanced(), generator)
    state, action = sample(generator, 200)
    truth = world(state, action)
    before, after = ((truth - f(state, action)).square().mean().sqrt() for f in (model, ekm))
    assert after < 0.25 * before


def test_scales_and_output_choice_cancel(generator: torch.Generator) -> None:
    state, action = sample(generator)
    state, action = state[0], action[0]
    ekm = enhanced(
        outputs=[2, 0], action_scale=0.5, output_scale=torch.tensor([10.0, 2.0], dtype=torch.float64)
    )
    for _ in range(30):  # one point, again and again: g must become the residual there
        ekm.update(state, action, world(state, action))
    residual = world(state, action) - model(state, action)
    g = ekm(state, action) - model(state, action)
    torch.testing.assert_close(g[[0, 2]], residual[[0, 2]], rtol=2e-2, atol=1e-3)
    assert g[1] == 0


@pytest.mark.parametrize("outputs", [None, [2, 0]])
def test_linearize_agrees_with_autograd(outputs: list[int] | None, generator: torch.Generator) -> None:
    ekm = train(enhanced(outputs=outputs, action_scale=0.7, output_scale=3.0), generator, 60)
    state, action = sample(generator)
    value, jacobian = ekm.linearize(state[0], action[0])
    torch.testing.assert_close(value, ekm(state[0], action[0]), rtol=0, atol=1e-12)
    expected = jacrev(lambda a: ekm(state[0], a))(action[0])
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-9)


def test_predict_is_in_the_increments_unit(generator: torch.Generator) -> None:
    ekm = train(enhanced(output_scale=100.0), generator, 50)
    state, action = sample(generator, 4)
    law = ekm.predict(state, action)
    torch.testing.assert_close(law.mean, ekm(state, action))
    assert (law.stddev < 0.011).all()  # unit prior variance over a scale of 100


@pytest.mark.usefixtures("unchecked")
def test_bad_samples_leave_the_learner_untouched(generator: torch.Generator) -> None:
    ekm = train(enhanced(), generator, 20)
    before = {name: value.clone() for name, value in ekm.learner.named_buffers()}
    state, action = sample(generator)
    good = world(state[0], action[0])
    with pytest.raises(NonFiniteError, match="increment"):
        ekm.update(state[0], action[0], good * torch.nan)
    with pytest.raises(NonFiniteError, match="action"):
        ekm.update(state[0], action[0] * torch.inf, good, good)
    with pytest.raises(NonFiniteError, match="state"):
        ekm.update(state[0] * torch.nan, action[0], good)
    with pytest.raises(ParameterError, match="action"):
        ekm.update(state[0], action[0].tolist(), good)
    with pytest.raises(ShapeError, match=r"action must have shape \(\*batch, 2\)"):
        ekm.linearize(state[0], action[0][:1], torch.zeros(3, 2))
    with pytest.raises(ShapeError, match="increment"):
        ekm.update(state[0], action[0], good[:2])
    for name, value in ekm.learner.named_buffers():
        assert torch.equal(value, before[name]), name


def test_wrong_kinds_and_widths_are_refused_by_name(generator: torch.Generator, unchecked) -> None:
    state, action = sample(generator)
    whole = torch.tensor([1, 2])
    for call in ("forward", "predict", "linearize"):
        with pytest.raises(ParameterError, match=r"torch\.int64.*floating-point"):  # f + g would be rounded
            getattr(enhanced(), call)(state[0], whole)
    with pytest.raises(ParameterError, match=r"floating-point"):
        enhanced().update(state[0], whole, model(state[0], action[0]))
    with pytest.raises(ParameterError, match="encode="):
        EnhancedModel(lambda s, a: a, SparseOnlineGP(N_S + N_A, N_A))(state[0].tolist(), action[0])
    with pytest.raises(ParameterError, match="indices"):
        EnhancedModel(model, SparseOnlineGP(N_S + N_A, 1), outputs=1)
    with pytest.raises(ShapeError, match=f"learner's input.*state {N_S} \\+ action {N_A} entries"):
        EnhancedModel(model, SparseOnlineGP(N_S, 3))(state[0], action[0])
    for learned, options in ((1, {}), (4, {}), (2, {"outputs": [1, 3]})):  # f has three entries
        ekm = EnhancedModel(model, SparseOnlineGP(N_S + N_A, learned), **options)
        with pytest.raises(ShapeError, match=r"f\(state, action\).*learner"):
            ekm(state[0], action[0])


@pytest.mark.parametrize("spoilt", ["state", "action", "increment"])
def test_a_learner_that_skips_leaves_bad_samples_out_here_too(generator, spoilt):
    ekm = train(enhanced(), generator, 20)
    ekm.learner.on_invalid = "skip"
    before = {name: value.clone() for name, value in ekm.learner.named_buffers()}
    state, action = sample(generator)
    sent = {"state": state[0], "action": action[0], "increment": world(state[0], action[0])}
    sent[spoilt] = sent[spoilt] * torch.nan
    assert not ekm.update(**sent).accepted
    assert int(ekm.learner.n_refused) == 1
    for name, value in ekm.learner.named_buffers():
        assert name == "n_refused" or torch.equal(value, before[name]), name
    assert ekm.predict(sent["state"], sent["action"]).mean.isfinite().all() == (spoilt == "increment")


def test_grasp_encoding_is_zero_at_the_reference_and_scaled(generator: torch.Generator) -> None:
    draw = lambda n: torch.randn(n, generator=generator, dtype=torch.float64)  # noqa: E731
    reference = GraspState(draw(4), draw(3), exp(draw(3)))
    encode = GraspEncoding(reference, [1, 3])
    assert encode.n_features == 8
    torch.testing.assert_close(encode(reference), torch.zeros(8, dtype=torch.float64), atol=1e-12, rtol=0)
    ds = torch.zeros(10, dtype=torch.float64)
    ds[3], ds[4], ds[9] = 0.3, 0.02, 0.15
    expected = torch.tensor([0, 1, 2, 0, 0, 0, 0, 0.5], dtype=torch.float64)
    torch.testing.assert_close(encode(reference.plus(ds)), expected, atol=1e-9, rtol=0)
    with pytest.raises(UnknownNameError):
        GraspEncoding(reference, [4])


def in_numpy(state: torch.Tensor, action: torch.Tensor) -> np.ndarray:
    """The same model, from a library that knows no tensors."""
    s, a = state.numpy(), action.numpy()
    return np.stack([a[..., 0], a[..., 1] * np.cos(s[..., 0]), a.prod(-1)], axis=-1)


def half_detached(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    value = model(state, action)
    return torch.cat([value[..., :2], value[..., 2:].detach()], dim=-1)


def test_a_model_that_fails_by_itself_says_so_itself() -> None:
    weights = torch.ones(N_S, 3, dtype=torch.float64)
    ekm = EnhancedModel(lambda s, a: s @ weights, SparseOnlineGP(N_S + N_A, 3, capacity=20))
    with pytest.raises(RuntimeError, match=r"size mismatch|shapes"):
        ekm.linearize(torch.zeros(N_S + 1).double(), torch.zeros(N_A).double())


@pytest.mark.parametrize(
    "f", [in_numpy, torch.no_grad()(model), lambda s, a: model(s, a).detach(), half_detached]
)
def test_a_model_without_derivative_is_refused_and_differences_help(f, generator: torch.Generator) -> None:
    n_x = N_S + N_A
    state, action = (one[0] for one in sample(generator))
    ekm = EnhancedModel(f, SparseOnlineGP(n_x, 3, capacity=20))
    ekm.update(state, action, world(state, action))  # learning and predicting need none
    torch.testing.assert_close(ekm.predict(state, action).mean, ekm(state, action))
    with pytest.raises(NoDerivativeError, match="finite-difference"):
        ekm.linearize(state, action)
    expected = EnhancedModel(model, ekm.learner).linearize(state, action)
    for jacobian in ("finite-difference", lambda s, a: jacrev(lambda b: model(s, b))(a).numpy()):
        given = EnhancedModel(f, ekm.learner, jacobian=jacobian).linearize(state, action)
        torch.testing.assert_close(given, expected, atol=1e-8, rtol=1e-8)
    with pytest.raises(ShapeError, match="jacobian"):
        EnhancedModel(f, ekm.learner, jacobian=lambda s, a: torch.eye(2)).linearize(state, action)


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("make", [lambda: SparseOnlineGP(N_S + N_A, 3), lambda: ReplayMLP(N_S + N_A, 3)])
def test_control_loops_need_no_autograd(context, make, generator: torch.Generator) -> None:
    ekm = train(EnhancedModel(model, make()), generator, 20)
    state, action = (one[0] for one in sample(generator))
    expected = ekm.linearize(state, action)
    with context():
        torch.testing.assert_close(ekm.linearize(state.clone(), action.clone()), expected, rtol=0, atol=0)
        ekm.update(state, action, world(state, action))


def test_states_of_inference_mode_may_be_nested() -> None:
    def f(state, action):
        return action * state["q"] + state["pair"][1]

    ekm = EnhancedModel(f, SparseOnlineGP(4, 2), encode=lambda state: state["q"])
    with torch.inference_mode():
        q, action = torch.rand(2, dtype=torch.float64), torch.rand(2, dtype=torch.float64)
        value, jacobian = ekm.linearize({"q": q, "pair": (q, [q][0])}, action)
    torch.testing.assert_close(value, action * q + q)
    torch.testing.assert_close(jacobian, q.diag())


def test_a_new_sequence_carries_nothing_over(generator: torch.Generator) -> None:
    ekm = train(EnhancedModel(model, MixtureResidual(SparseOnlineGP(N_S + N_A, 3))), generator, 60)
    assert bool(ekm.learner.innovation.any())
    ekm.new_sequence()
    assert not bool(ekm.learner.innovation.any())
    EnhancedModel(model, SparseOnlineGP(N_S + N_A, 3)).new_sequence()  # has nothing to drop


@pytest.mark.parametrize("jacobian", [None, "finite-difference"])
def test_batches_and_dtypes(jacobian, generator: torch.Generator) -> None:
    ekm = train(enhanced(outputs=[2, 0, 1], action_scale=0.7, jacobian=jacobian), generator, 40)
    states, actions = sample(generator, 6)
    for shape in ((6,), (2, 3)):
        value, J = ekm.linearize(states.view(*shape, N_S), actions.view(*shape, N_A))
        for i in range(6):
            one = ekm.linearize(states[i], actions[i])
            torch.testing.assert_close(value.view(6, -1)[i], one[0], atol=1e-11, rtol=0)
            torch.testing.assert_close(J.view(6, 3, N_A)[i], one[1], atol=1e-8, rtol=0)
    s, a = states[0].float(), actions[0].float()
    law = ekm.predict(s, a)
    single = (*ekm.linearize(s, a), ekm(s, a), law.mean, law.stddev)
    assert {one.dtype for one in single} == {torch.float32}


@pytest.mark.parametrize(
    "wrong",
    [
        {"model": 3.0},
        {"learner": torch.nn.Linear(5, 3)},
        {"encode": "identity"},
        {"outputs": [0, 0, 1]},
        {"outputs": [0, 1]},
        {"action_scale": 0.0},
        {"output_scale": [1.0, 2.0]},
        {"output_scale": torch.tensor([1.0, torch.nan, 2.0])},
        {"jacobian": "exact"},
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_arguments_are_checked(wrong: dict) -> None:
    given = {"model": model, "learner": SparseOnlineGP(N_S + N_A, 3, capacity=4), **wrong}
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        EnhancedModel(given.pop("model"), given.pop("learner"), **given)


def test_a_linearized_model_has_the_dtype_of_the_action() -> None:
    class Linear:
        def linearize(self, state: torch.Tensor) -> SimpleNamespace:
            return SimpleNamespace(manipulation_jacobian=torch.eye(2, dtype=torch.float64))

        def __call__(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return action

    model = EnhancedModel(Linear(), RecursiveLeastSquares(4, 2, dtype=torch.float32))
    value, jacobian = model.linearize(torch.zeros(2), torch.ones(2))
    assert value.dtype == jacobian.dtype == torch.float32
