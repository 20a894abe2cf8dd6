"""What a stream of somebody else's may hold, and what somebody may ask: it works or is refused by name."""

import copy
import itertools
from collections.abc import Callable

import pytest
import torch
from as_published import deep_sogp, sogp

from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError, StateError, UnknownNameError
from torch_ekm.residual import (
    ActionLinearKernel,
    DeepKernelSOGP,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    MixtureResidual,
    ProcessNoise,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
    ZeroResidual,
    default_learner,
)

NAN = float("nan")


def stream(n: int, *shape: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, *shape, 3, generator=generator, dtype=torch.float64)
    return x, torch.sin(x[..., :2])


@pytest.mark.parametrize("offset", [1e4, 1e6])
def test_a_stationary_kernel_does_not_care_where_the_inputs_lie(offset):
    x, y = stream(150)
    near, far = (sogp(3, 2, capacity=30) for _ in range(2))
    near.update(x, y)
    far.update(x + offset, y)
    queries = stream(40, seed=1)[0]
    # the inputs themselves are rounded to offset * 1e-16
    torch.testing.assert_close(far(queries + offset), near(queries), atol=1e-15 * offset * 1e3, rtol=0)
    assert float(far.predict(queries + offset).stddev.min()) > 0.5 * float(near.predict(queries).stddev.min())


@pytest.mark.parametrize(
    ("offset", "bound", "dtype"),
    [(1e6, 0.6, torch.float64), (1e8, 1.0, torch.float64), (1e3, 0.3, torch.float32)],
)
def test_least_squares_far_from_the_origin(offset, bound, dtype):
    x = stream(200)[0].to(dtype)
    y = x @ torch.tensor([[1.0], [-2.0], [0.5]], dtype=dtype)
    rls = RecursiveLeastSquares(3, 1, dtype=dtype)
    rls.update(x + offset, y)
    assert bool(rls(x + offset).isfinite().all())
    assert float((rls(x + offset) - y).square().mean().sqrt()) < bound * float(y.std())


@pytest.mark.parametrize("value", [1e200, -1e300])
@pytest.mark.parametrize(
    "make",
    [
        lambda: sogp(3, 2, capacity=8, parts=[Standardize()]),
        lambda: RecursiveLeastSquares(3, 2),
        lambda: MixtureResidual(sogp(3, 2, capacity=8)),
    ],
)
def test_numbers_without_a_square_are_refused(make, value):
    x, y = stream(20)
    g = make()
    g.update(x, y)
    before = copy.deepcopy(g.state_dict())
    for k in (0, 1):
        pair = [x[0].clone(), y[0].clone()]
        pair[k][1] = value
        with pytest.raises(NonFiniteError, match="square"):
            g.update(*pair)
    for name, now in g.state_dict().items():
        assert torch.equal(now, before[name]) if isinstance(now, torch.Tensor) else now == before[name]


@pytest.mark.parametrize(
    "part", [LearnHyperparameters(), ForgettingFactor(0.9), ProcessNoise(0.05), Standardize()]
)
def test_a_step_without_a_sample_leaves_no_trace_even_when_a_rebuild_is_due(part):
    x, y = stream(40)
    for on_invalid in ("raise", "skip"):
        g = sogp(3, 2, capacity=10, refresh_every=8, on_invalid=on_invalid, parts=[part])
        g.update(x[:7], y[:7])
        other = copy.deepcopy(g)
        if on_invalid == "raise":
            report = g.update(x[7], y[7], torch.tensor(False))
        else:
            report = g.update(torch.full_like(x[7], torch.nan), y[7])
        assert int(report.event) == 0
        assert torch.equal(g(x), other(x))
        for learner in (g, other):  # and the stream goes on as if it had never come
            learner.update(x[8:], y[8:])
        assert torch.equal(g(x), other(x))


@pytest.mark.parametrize("shape", [(3,), (1, 3), (4, 1, 3), (4, 5, 3)])
def test_a_query_may_ask_all_models_of_a_fleet(shape):
    fleets = [
        ZeroResidual(3, 2, batch_shape=(5,)),
        RecursiveLeastSquares(3, 2, batch_shape=(5,)),
        RandomFeatureRLS(3, 2, n_frequencies=9, batch_shape=(5,)),
        sogp(3, 2, capacity=6, batch_shape=(5,)),
        deep_sogp(3, 2, capacity=6, hidden=(4,), features=2, batch_shape=(5,)),
        MixtureResidual(sogp(3, 2, capacity=6, batch_shape=(5,))),
    ]
    x, y = stream(12, 5)
    query = torch.randn(shape, dtype=torch.float64)
    whole = query.expand(*(shape[:-2] if len(shape) > 2 else ()), 5, 3)
    for g in fleets:
        g.update(x, y)
        for ask in (g, lambda q, g=g: g.predict(q).stddev, lambda q, g=g: g.linearize(q)[1]):
            torch.testing.assert_close(ask(query), ask(whole), atol=1e-14, rtol=1e-13)  # rounding alone


def test_a_fleet_that_detects_changes_with_a_memory_is_so_many_single_models():
    x, y = stream(400, 3)
    y[250:, 1] *= -3.0
    options = {
        "capacity": 12, "noise_variance": 0.01,
        "parts": [RobustWeight(3.0), DetectChanges(), LearnHyperparameters(memory=50)],
    }  # fmt: skip
    fleet = sogp(3, 2, batch_shape=(3,), **options)
    fleet.update(x, y)
    for i in range(3):
        single = sogp(3, 2, **options)
        single.update(x[:, i], y[:, i])
        torch.testing.assert_close(fleet(x[:9])[:, i], single(x[:9, i]), atol=1e-9, rtol=0)


def test_units_of_a_model_with_masks_are_those_of_its_own_samples():
    x, y = stream(63, 2, 3)  # a block ends there
    mask = torch.rand(63, 2, 3, generator=torch.Generator().manual_seed(1)) < 0.7
    fleet = sogp(3, 2, capacity=12, batch_shape=(2, 3), parts=[Standardize()])
    fleet.update(x, y, mask)
    units = fleet.units
    units.input.settle(settled=0.0)
    units.output.settle(settled=0.0)
    for i, j in itertools.product(range(2), range(3)):
        own_x, own_y = x[mask[:, i, j], i, j], y[mask[:, i, j], i, j]
        torch.testing.assert_close(units.input.shift[i, j], own_x.mean(0), atol=0.05, rtol=0)
        torch.testing.assert_close(units.input.scale[i, j], own_x.std(0, correction=0), atol=0, rtol=0.1)
        torch.testing.assert_close(units.output.scale[i, j], own_y.square().mean(0).sqrt(), atol=0, rtol=0.1)


def test_each_model_of_a_fleet_gets_a_kernel_of_its_own():
    """The fleet is as large as the inputs are wide."""
    x, y = stream(64, 3)
    kernel, parts = SquaredExponential(3), [LearnHyperparameters()]
    gp = sogp(3, 2, capacity=8, batch_shape=(3,), kernel=kernel, parts=parts)
    gp.update(x, y, torch.tensor([True, False, False]).expand(64, 3))
    sogp(3, 2, kernel=kernel, parts=parts).update(x[:, 0], y[:, 0])  # a single model has its own, too
    assert torch.equal(kernel.log_lengthscale, SquaredExponential(3).log_lengthscale)
    moved = gp.kernel.log_lengthscale != kernel.log_lengthscale
    assert moved.all(-1).tolist() == moved.any(-1).tolist() == [True, False, False]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        *((SparseOnlineGP, {"capacity": bad}) for bad in (None, NAN, 0, 2.5)),
        *((SparseOnlineGP, {"batch_shape": bad}) for bad in (3, (0,))),
        *((SparseOnlineGP, {"noise_variance": bad}) for bad in (None, "a", 0.0, -1.0, NAN)),
        *((SparseOnlineGP, {"novelty_threshold": bad}) for bad in (-0.1, 1.0)),
        *((SparseOnlineGP, {"refresh_every": bad}) for bad in ("often", 0)),
        *(
            (SparseOnlineGP, {"kernel": SquaredExponential(n, batch_shape=s)})
            for n, s in ((4, ()), (3, (2,)))
        ),
        (SparseOnlineGP, {"kernel": "se"}),
        (SparseOnlineGP, {"dtype": torch.int64}),
        (SparseOnlineGP, {"on_invalid": "ignore"}),
        (DeepKernelSOGP, {"hidden": 8}),
        *((RandomFeatureRLS, {"lengthscale": bad}) for bad in (0.0, NAN, [1.0, 2.0])),
        *(
            (default_learner, {"input_resolution": bad})
            for bad in (-1.0, NAN, [1.0, 2.0], "a", [1.0, None, 1.0])
        ),
        *((default_learner, {"batch_shape": 3}), (DeepKernelSOGP, {"batch_shape": 3})),
    ],
)
def test_options_that_cannot_be_are_named(kind, options):
    with pytest.raises(ParameterError, match=next(iter(options))) as refused:
        kind(3, 2, **options)
    assert "fleet of ()" not in str(refused.value)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("engine", ["compiled", "torch"])
@pytest.mark.parametrize("make", [default_learner, SparseOnlineGP, RecursiveLeastSquares])
def test_a_query_with_a_nan_returns_nan(make, engine) -> None:
    g = make(3, 2)
    if engine == "torch":
        for one in g.modules():
            if hasattr(one, "engine"):
                one.engine = None
    x = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    g.update(x, x[:, :2])
    query = torch.tensor([0.1, torch.nan, 0.3], dtype=torch.float64)
    told = [g(query), *g.moments(query), *g.linearize(query), g(torch.stack([x[0], query]))[1]]
    told += g.moments(query, observation=True)
    told += g.predict_with_jacobians(query) if hasattr(g, "predict_with_jacobians") else ()
    assert all(bool(each.isnan().all()) for each in told)
    assert bool(g(x[0]).isfinite().all())


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("make", [lambda: default_learner(3, 2), lambda: RecursiveLeastSquares(3, 2)])
def test_what_is_no_real_number_is_named(make):
    learner, x, y = make(), torch.zeros(3), torch.zeros(2)
    before = copy.deepcopy(learner.state_dict())
    with pytest.raises(ParameterError, match="x = None"):
        learner.update(None, y)
    with pytest.raises(ParameterError, match="y = None"):
        learner.update(x, None)
    with pytest.raises(ParameterError, match=r"y = torch.complex64 .* real numbers"):
        learner.update(x, y.to(torch.complex64))
    with pytest.raises(ParameterError, match=r"y = dtype\('complex64'\) .* real numbers"):
        learner.update(x, y.numpy() * 1j)
    with pytest.raises(ParameterError, match="mask = 'all'"):
        learner.update(x, y, "all")
    for name, value in learner.state_dict().items():
        assert not isinstance(value, torch.Tensor) or torch.equal(value, before[name])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("make", [default_learner, RecursiveLeastSquares])
def test_a_learner_made_in_inference_mode_is_named(make):
    with torch.inference_mode():
        learner = make(3, 2)
    with pytest.raises(StateError, match="make it outside"):
        learner.update(torch.zeros(3), torch.zeros(2))


@pytest.mark.parametrize("make", [default_learner, SparseOnlineGP])
def test_samples_of_a_model_with_parameters_are_taken_without_their_graph(make):
    plain, given = make(3, 2), make(3, 2)
    for x, y in zip(*stream(12), strict=True):
        plain.update(x, y)
        given.update(x.clone().requires_grad_(True), y.clone().requires_grad_(True))
    assert torch.equal(plain(x), given(x))


@pytest.mark.usefixtures("unchecked")
def test_an_option_of_the_default_learner_that_there_is_not_is_named():
    with pytest.raises(UnknownNameError, match=r"'forgetting'; valid are: capacity, .*batch_shape"):
        default_learner(3, 2, forgetting=0.99)


@pytest.mark.usefixtures("unchecked")
def test_masks_may_be_lists_of_bools_only():
    gp = sogp(3, 2, capacity=5, batch_shape=(2,))
    x, y = stream(1, 2)
    report = gp.update(x[0], y[0], [True, False])
    assert report.accepted.tolist() == [True, False]
    with pytest.raises(ShapeError, match="int64"):
        gp.update(x[0], y[0], [1, 0])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: default_learner(-1, 2), "in_features = -1"),
        (lambda: sogp(0, 2), "in_features"),
        (lambda: ActionLinearKernel(3, 3), "action_features"),
        (lambda: ActionLinearKernel(3, 1, state_kernel=SquaredExponential(2, batch_shape=(3,))), "kernel"),
        (lambda: SquaredExponential(3, lengthscale=[1.0, 2.0]), "lengthscale"),
        (lambda: RecursiveLeastSquares(1, 1, forgetting_factor="0.9"), "factor"),
        *((lambda bad=bad: ForgettingFactor(bad), "factor") for bad in (None, 0.0, 1.1)),
        *((lambda bad=bad: ProcessNoise(bad), "share") for bad in ("a", 1.0, -0.1)),
        *((lambda bad=bad: RobustWeight(bad), "threshold") for bad in (10**400, 0.0)),
        (lambda: LearnHyperparameters(rate=-1.0), "rate"),
        (lambda: LearnHyperparameters(steps=0), "steps"),
        *((lambda bad=bad: LearnHyperparameters(memory=bad), "memory") for bad in (-1, "many")),
        (lambda: MixtureResidual([]), "learners"),
        (lambda: MixtureResidual([ZeroResidual(2, 1), ZeroResidual(2, 2)]), "same"),
        (lambda: MixtureResidual([ZeroResidual(2, 1)] * 2), "twice"),
        (lambda: MixtureResidual(ZeroResidual(2, 1), batch_shape=(2,)), "batch_shape"),
        *(
            (lambda bad=bad: MixtureResidual(ZeroResidual(1, 1), levels=bad), "levels")
            for bad in ((), (1.5,), (-0.1,))
        ),
        (lambda: MixtureResidual(ZeroResidual(1, 1), trends=(2.0,)), "trends"),
        (lambda: MixtureResidual(ZeroResidual(1, 1), levels=(0.0,), trends=(0.5,)), "trends"),
        *(
            (lambda bad=bad: MixtureResidual(ZeroResidual(1, 1), doubts=bad), "doubts")
            for bad in ((1.0, 1.0), (-1.0,))
        ),
        *(
            (lambda p=p: ZeroResidual(2, 1).interval(torch.zeros(2), p), r"in \(0, 1")
            for p in (0.0, 1.0, -0.1, NAN)
        ),
        *(
            (lambda p=p: ZeroResidual(2, 1).quantile(torch.zeros(2), p), r"in \(0, 1")
            for p in (0.0, 1.0, -0.1, NAN)
        ),
        (lambda: ZeroResidual(2, 1).sample(torch.zeros(2), 0), "n = 0"),
        (lambda: EnhancedModel(torch.add, ZeroResidual(1, 1), action_scale="2"), "action_scale"),
        (lambda: EnhancedModel(torch.add, ZeroResidual(1, 1), output_scale=None), "output_scale"),
    ],
)
def test_arguments_that_cannot_be_are_named(make: Callable[[], object], named: str) -> None:
    with pytest.raises(ParameterError, match=named):
        make()


@pytest.mark.parametrize("steps", [1, 2, 7, 12, 32, 40])
def test_as_many_gradient_steps_as_asked_for(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    descend = LearnHyperparameters.descend
    monkeypatch.setattr(
        LearnHyperparameters, "descend", lambda *what, **how: made.append(1) or descend(*what, **how)
    )
    learner = SparseOnlineGP(1, 1, refresh_every=32, parts=[LearnHyperparameters(steps=steps)])
    for x in torch.linspace(-1, 1, 64)[:, None]:
        learner.update(x, x.sin())
    assert len(made) == 2 * min(steps, 32)
