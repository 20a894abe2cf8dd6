"""Checks for authors of learners and drivers: a contract as one call, ``check_residual_learner(factory)``."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.distributions import Normal

from .exceptions import EKMError, NonFiniteError, NoStateError, ParameterError, ShapeError, StateMismatchError
from .plant import FollowingPlant, Observation, Path
from .residual.base import ResidualLearner, UpdateReport
from .residual.kernels.kernel import Kernel

__all__ = ["check_following_plant", "check_residual_learner"]

QUERY_SHAPES = ((), (1,), (5,), (2, 3))


def check_residual_learner(
    factory: Callable[..., ResidualLearner],
    *,
    dtypes: tuple[torch.dtype, ...] = (torch.float64, torch.float32),
    n_samples: int = 24,
    differentiable: bool = True,
    separates_noise: bool = True,
    has_state: bool = True,
) -> None:
    """Assert every clause of the learner contract that a short stream can show, each dtype and query shape.

    What it cannot show: that memory stays constant, that refused samples leave no trace in a stream of
    thousands. Run a long one for these.

    Args:
        factory: ``factory(dtype=...)`` gives a fresh learner, the same one each time, on any device.
        dtypes: floating types to try.
        n_samples: length of the stream that is learned.
        differentiable: whether gradients of ``forward`` reach x and equal ``linearize``, also in ``vmap``.
        separates_noise: whether ``predict(x, observation=True)`` is wider than ``predict(x)``.
        has_state: whether it has a state dict; without one it raises NoStateError, and is copied and
            pickled only.

    Raises:
        AssertionError: naming the first clause that is violated.
        ParameterError: ``factory`` is a learner.
    """
    if isinstance(factory, ResidualLearner):
        valid = f"a factory: lambda **options: {type(factory).__name__}(3, 2, **options)"
        raise ParameterError("factory", factory, valid)
    for dtype in dtypes:
        learner = factory(dtype=dtype)
        x, y = _stream(learner, n_samples)
        _check_module(learner)
        _check_prior(learner, x)
        _check_bad_input(learner, x, y, has_state)
        given = x.clone(), y.clone()
        for t in range(n_samples // 2):
            _check_report(learner.update(x[t], y[t]), learner)
        rest = slice(n_samples // 2, None)
        _check_report(learner.update(x[rest], y[rest]), learner, len(x[rest]))
        assert torch.equal(x, given[0]), "update changed the caller's x"
        assert torch.equal(y, given[1]), "update changed the caller's y"
        _check_bad_input(learner, x, y, has_state)
        _check_learns(learner, x, separates_noise)
        _check_queries(learner, x)
        if differentiable:
            _check_gradients(learner, x)
        _check_modes(learner, x)
        _check_persistence(learner, factory, x, y, has_state)
        _check_mask(learner, x, y)
        _check_skip(learner, x, y)
        _check_batch_is_sequence(factory, learner, x, y)
        learner.reset()
        _check_prior(learner, x)
        _check_reset(learner, factory, x)
        _check_bounds(learner)


def check_following_plant(plant: FollowingPlant, path: Path, *, tolerance: float) -> None:
    """Assert what the contract says of ``follow``: along ``path``, and back until the first reading.

    Args:
        plant: opened, with room for the path, which takes several periods of its sensors.
        tolerance: how far from a set-point the motors may stop, by dead zones and biases [rad]; shorter than
            the path.

    Raises:
        AssertionError: naming the first clause that is violated.
    """
    passed: list[Observation] = []
    goals, start = path.waypoints, plant.observe()
    end = plant.follow(path, lambda seen: passed.append(seen) or True)
    times = [seen.time for seen in (start, *passed, end)]
    assert passed, "no reading on the way is given to watch"
    assert times == sorted(times), "readings on the way are not in the order of time"
    off = float((end.a - start.a - goals[-1]).abs().max())
    assert off <= tolerance, f"the motors end {off:.3g} rad from the last waypoint"
    later = float((plant.observe().a - end.a).abs().max())
    assert later <= tolerance, f"the motors move on by {later:.3g} rad after follow has returned"
    back = torch.cat([goals.flip(0)[1:], torch.zeros_like(goals[:1])]) - goals[-1]
    asked: list[Observation] = []
    way = Path(back, path.durations.flip(0).cumsum(0))
    left = float((plant.follow(way, lambda seen: bool(asked.append(seen))).a - start.a).abs().max())
    assert len(asked) == 1, "watch is asked again after it has answered False"
    assert left > tolerance, "the motors go on where watch answers False"
    wrong = Path(torch.zeros(1, goals.shape[1] + 1), torch.ones(1))
    _raises(lambda: plant.follow(wrong, lambda seen: True), EKMError, "waypoints of another hand")


def _stream(learner: ResidualLearner, n: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (n, *learner.batch_shape)
    x = torch.randn(*shape, learner.in_features, generator=generator, dtype=torch.float64)
    w = torch.randn(learner.in_features, learner.out_features, generator=generator, dtype=torch.float64)
    y = torch.sin(x @ w)
    return x.to(learner.device, learner.dtype), y.to(learner.device, learner.dtype)


def _check_module(learner: ResidualLearner) -> None:
    assert isinstance(learner, nn.Module), "not an nn.Module"
    assert isinstance(learner, ResidualLearner), "not a ResidualLearner"
    assert str(learner.in_features) in repr(learner), "repr does not show in_features"
    assert not any(p.requires_grad for p in learner.parameters()), "a parameter requires grad"


def _check_prior(learner: ResidualLearner, x: Tensor) -> None:
    assert torch.equal(learner(x), torch.zeros_like(learner(x))), "prior mean is not exactly 0"
    law = learner.predict(x[0])
    assert bool((law.stddev > 0).all()), "prior deviation is not positive"


def _check_report(report: UpdateReport, learner: ResidualLearner, n: int | None = None) -> None:
    shape = learner.batch_shape if n is None else (n, *learner.batch_shape)
    for name in ("event", "novelty", "nis", "weight"):
        assert getattr(report, name).shape == torch.Size(shape), f"report.{name} has the wrong shape"
    assert bool(report.accepted.all()), "a good sample was not accepted"
    for name in ("novelty", "weight"):  # nis may be NaN: a learner without uncertainty has none
        assert bool(getattr(report, name).isfinite().all()), f"report.{name} is not finite"


def _check_learns(learner: ResidualLearner, x: Tensor, separates_noise: bool) -> None:
    mean, law = learner(x), learner.predict(x, observation=True)
    assert bool(mean.isfinite().all() and law.stddev.isfinite().all()), "a prediction is not finite"
    assert bool((law.stddev > 0).all()), "a deviation is not positive"
    latent = learner.predict(x)
    assert bool((latent.stddev <= law.stddev + 1e-6).all()), "noise makes a prediction more certain"
    if separates_noise:
        assert bool((latent.stddev < law.stddev).any()), "observation=True adds no noise"


def _check_queries(learner: ResidualLearner, x: Tensor) -> None:
    for shape in QUERY_SHAPES:
        query = x[0].expand(*shape, *x[0].shape).contiguous()
        expected = (*shape, *learner.batch_shape, learner.out_features)
        mean, law = learner(query), learner.predict(query)
        assert isinstance(law, Normal), "predict does not return a Normal"
        assert mean.shape == law.mean.shape == law.stddev.shape == torch.Size(expected), f"shape at {shape}"
        assert mean.dtype == law.stddev.dtype == learner.dtype, "the prediction has another dtype"
        density = learner.predictive(query).log_prob(mean)
        assert density.shape == mean.shape, f"predictive: shape of the log density at {shape}"
        assert bool(density.isfinite().all()), "predictive: a log density is not finite"
        value, jacobian = learner.linearize(query)
        assert value.shape == torch.Size(expected), f"linearize: shape of the mean at {shape}"
        assert jacobian.shape == (*expected, learner.in_features), f"linearize: shape at {shape}"
        one = learner(x[0])
        _close(mean, one.expand_as(mean), learner, "a batch differs from its entries")
        _close(law.mean, mean, learner, "predict and forward differ")
        _close(value, mean, learner, "linearize and forward differ")


def _check_gradients(learner: ResidualLearner, x: Tensor) -> None:
    tolerance = 1e-8 if learner.dtype == torch.float64 else 1e-3
    query = x[0].clone().requires_grad_(True)
    jacobian = learner.linearize(query)[1].detach()
    value = learner(query)
    message = (
        "no gradient of forward reaches x: add 0.0 * x[..., :1] for a slope of 0, or differentiable=False"
    )
    assert value.requires_grad, message
    for j in range(learner.out_features):
        (row,) = torch.autograd.grad(value[..., j].sum(), query, retain_graph=True)
        error = float((row - jacobian[..., j, :]).abs().max())
        assert error <= tolerance, f"linearize is not the gradient of forward: off by {error:.1e}"
    if not learner.batch_shape:
        full = torch.func.vmap(torch.func.jacrev(learner))(x[:3])
        error = (full - learner.linearize(x[:3])[1]).abs().max()
        assert float(error) <= tolerance, "vmap of jacrev differs from linearize"


def _check_modes(learner: ResidualLearner, x: Tensor) -> None:
    mean = learner.train()(x)
    assert torch.equal(mean, learner.eval()(x)), "train() and eval() predict differently"


def _check_bad_input(learner: ResidualLearner, x: Tensor, y: Tensor, has_state: bool) -> None:
    before = _figures(learner, has_state)
    cases: list[tuple[str, Tensor, Tensor]] = [
        ("width of x", x[0][..., :-1], y[0]),
        ("width of y", x[0], torch.cat([y[0], y[0]], -1)),
        ("empty batch", x[:0], y[:0]),
        ("lengths", x[:3], y[:2]),
    ]
    for name, bad_x, bad_y in cases:
        _raises(lambda a=bad_x, b=bad_y: learner.update(a, b), ShapeError, name)
    if learner.on_invalid == "raise":
        for value in (float("nan"), float("inf")):
            for which in (0, 1):
                pair = [x[:3].clone(), y[:3].clone()]
                pair[which][2, ..., -1] = value  # the last of a block: the first must not stay
                _raises(lambda p=pair: learner.update(*p), NonFiniteError, f"{value} in a sample")
    _raises(lambda: learner(x[0][..., :-1]), ShapeError, "width of a query (self.check_query)")
    assert _same(before, _figures(learner, has_state)), "a refused sample changed the state"


def _check_mask(learner: ResidualLearner, x: Tensor, y: Tensor) -> None:
    before, mask = learner(x), torch.zeros(learner.batch_shape, dtype=torch.bool, device=learner.device)
    report = copy.deepcopy(learner).update(x[0], y[0], mask)
    assert not bool(report.accepted.any()), "a masked sample is reported as accepted"
    masked = copy.deepcopy(learner)
    masked.update(torch.full_like(x[0], float("nan")), y[0], mask)
    _close(masked(x), before, learner, "a masked sample changed predictions", factor=100)
    if mask.numel() > 1:
        some = copy.deepcopy(learner)
        mask.view(-1)[0] = True
        accepted = some.update(x[0], y[0] + 1.0, mask).accepted
        assert torch.equal(accepted, mask), "the report accepts other samples than those of the mask"
        _close(some(x)[:, ~mask], before[:, ~mask], learner, "models without a sample learned", factor=100)


def _check_skip(learner: ResidualLearner, x: Tensor, y: Tensor) -> None:
    """Refused samples are counted, and learned by nobody, where a learner skips them."""
    skipping = copy.deepcopy(learner)
    skipping.on_invalid = "skip"
    before, refused = skipping(x), skipping.n_refused.clone()
    report = skipping.update(torch.full_like(x[0], float("nan")), y[0])
    assert not bool(report.accepted.any()), "a skipped sample is reported as accepted"
    assert bool((skipping.n_refused == refused + 1).all()), "a skipped sample is not counted"
    _close(skipping(x), before, learner, "a skipped sample changed predictions", factor=100)


def _check_reset(learner: ResidualLearner, factory: Callable, x: Tensor) -> None:
    """``learner`` was reset; if its hyperparameters did not move it must be as new."""
    fresh = factory(dtype=learner.dtype)
    if all(map(torch.equal, _learned(learner), _learned(fresh))):
        deviations = learner.predict(x).stddev, fresh.predict(x).stddev
        _close(*deviations, learner, "reset() leaves the deviation of what was learned")


def _learned(learner: ResidualLearner) -> list[Tensor]:
    """Hyperparameters that a reset keeps."""
    kernels = [one for one in learner.modules() if isinstance(one, Kernel)]
    noise = [t for name, t in learner.named_buffers() if name.endswith("log_noise_variance")]
    return [*(t for one in kernels for t in one.hyperparameters().values()), *noise, *learner.parameters()]


def _check_bounds(learner: ResidualLearner) -> None:
    """Nothing that an input does which stood still makes the learner say nonsense."""
    x, y = _stream(learner, 48)
    x[:24, ..., -1] *= 1e-12
    moves = "an input that stood still and moves"
    for t in range(len(x)):
        mean, most = learner(x[t]), y[:t].abs().amax(0) if t else 0.0 * y[0]
        assert bool(mean.isfinite().all()), f"{moves} makes the mean NaN or infinite"
        within = mean.abs() <= 3.0 * most + 1e-9
        assert bool(within.all()), f"{moves} makes |g| 3 times the largest |y| and more: self.bounded(mean)"
        learner.update(x[t], y[t])


def _check_persistence(
    learner: ResidualLearner, factory: Callable, x: Tensor, y: Tensor, has_state: bool
) -> None:
    copies = {"deepcopy": copy.deepcopy(learner), "pickle": pickle.loads(pickle.dumps(learner))}
    if has_state:
        copies["state_dict"] = factory(dtype=learner.dtype)
        _check_damaged_state(learner, copies["state_dict"])
        file = io.BytesIO()
        torch.save(learner.state_dict(), file)
        file.seek(0)
        copies["state_dict"].load_state_dict(torch.load(file, weights_only=True))
    else:
        _raises(learner.state_dict, NoStateError, "has_state=False")
    original = copy.deepcopy(learner)
    original.update(x, y)
    for name, other in copies.items():
        same = torch.equal(other(x), learner(x))
        assert same, f"{name}: the mean is not bit for bit the same; is all that is learned in buffers?"
        assert torch.equal(other.predict(x).stddev, learner.predict(x).stddev), f"{name}: another deviation"
        other.update(x, y)
        assert torch.equal(other(x), original(x)), f"{name}: the stream does not continue identically"
    single = copy.deepcopy(learner).to(torch.float32)
    assert single(x.float()).dtype == torch.float32, ".to(float32) does not change predictions' dtype"
    _close(single(x.float()).to(x), learner(x), single, ".to(float32) changed the prediction", factor=100)
    single.update(x.float(), y.float())
    message = "after .to(float32) it learns differently"
    _close(single(x.float()).to(x), original(x), single, message, factor=1000)


def _check_damaged_state(learner: ResidualLearner, fresh: ResidualLearner) -> None:
    """A state that is not one of this learner is refused whole: the last entry decides on the first."""
    before = copy.deepcopy(fresh.state_dict())
    good = copy.deepcopy(learner.state_dict())
    tensors = [name for name, value in good.items() if isinstance(value, Tensor)]
    figures = [name for name in tensors if good[name].is_floating_point() and good[name].numel()]
    damaged = {"shape": {**good, tensors[-1]: good[tensors[-1]].new_zeros(7, 3, 1)}}
    damaged["missing"] = {name: value for name, value in good.items() if name != tensors[-1]}
    if figures:
        damaged["NaN"] = {**good, figures[-1]: torch.full_like(good[figures[-1]], torch.nan)}
    for name, state in damaged.items():
        _raises(lambda s=state: fresh.load_state_dict(s), StateMismatchError, f"state dict: {name}")
        assert _same(before, fresh.state_dict()), f"state dict: half of a damaged one was loaded ({name})"


def _figures(learner: ResidualLearner, has_state: bool) -> dict:
    if has_state:
        return copy.deepcopy(learner.state_dict())
    return {name: value.clone() for name, value in learner.named_buffers()}


def _check_batch_is_sequence(factory: Callable, learner: ResidualLearner, x: Tensor, y: Tensor) -> None:
    block, single = (factory(dtype=learner.dtype) for _ in range(2))
    block.update(x, y)
    for t in range(len(x)):
        single.update(x[t], y[t])
    assert torch.equal(block(x), single(x)), "a block differs from its samples one by one"


def _raises(call: Callable, error: type[EKMError], name: str) -> None:
    try:
        call()
    except error:
        return
    raise AssertionError(f"{name}: expected a {error.__name__}")


def _same(a: dict, b: dict) -> bool:
    def equal(u: object, v: object) -> bool:
        if isinstance(u, Tensor) and isinstance(v, Tensor):
            return torch.equal(u, v)
        return _same(u, v) if isinstance(u, dict) and isinstance(v, dict) else u == v

    return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)


def _close(a: Tensor, b: Tensor, learner: ResidualLearner, message: str, factor: float = 1.0) -> None:
    tolerance = factor * (1e-9 if learner.dtype == torch.float64 else 1e-5)
    a, b = a.detach(), b.detach()
    error = float((a - b).abs().max())
    assert error <= tolerance * max(1.0, float(b.abs().max())), f"{message} (by {error:.1e})"
