"""Compiled loops do what torch does, share its memory, and step back where torch must work."""

import copy
import importlib
import subprocess
import sys

import pytest
import torch

from torch_ekm.exceptions import SpeedWarning
from torch_ekm.residual import (
    ActionLinearKernel,
    CalibrateNoise,
    DeepKernel,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    LinearKernel,
    Matern32,
    ProcessNoise,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
    warm_up,
)
from torch_ekm.residual.sparse_gp.engine import loading

D, M = 4, 2


def hard_stream(n: int, *fleet: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Motion with rests, outliers and a jump of the system."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, *fleet, D, generator=generator, dtype=torch.float64)
    noise = torch.randn(n, *fleet, M, generator=generator, dtype=torch.float64)
    x[n // 4 : n // 4 + 20] = x[n // 4].clone()
    y = torch.sin(x[..., :M] + x[..., M:]) + 0.1 * noise
    y[n // 2 :] -= 2.0
    y[::37] += 30.0 * noise[::37]
    return x, y


def all_parts() -> list:
    return [
        RobustWeight(3.0), CalibrateNoise(), DetectChanges(), ForgettingFactor(0.995), Standardize(),
        LearnHyperparameters(memory=50),
    ]  # fmt: skip


OPTIONS = {
    "plain": lambda shape: {},
    "matern32": lambda shape: {"kernel": Matern32(D, lengthscale=[1.0, 2.0, 3.0, 4.0], batch_shape=shape)},
    "one kernel": lambda shape: {"kernel": Matern32(D, variance=2.0)},
    "action": lambda shape: {
        "kernel": ActionLinearKernel(D, 2, state_kernel=Matern32(2, batch_shape=shape), batch_shape=shape),
        "parts": [Standardize(), RobustWeight(3.0)],
    },
    "linear": lambda shape: {
        "kernel": LinearKernel(D, slope_variance=[0.5, 1.0, 2.0, 4.0], variance=0.7, batch_shape=shape),
        "parts": [Standardize(), RobustWeight(3.0)],
    },
    "deep": lambda shape: {
        "kernel": DeepKernel(SquaredExponential(D), hidden=(8,)),
        "parts": [Standardize()],
    },
    "unknown": lambda shape: {"kernel": Periodic(D)},
    "noises": lambda shape: {"noise_variance": torch.tensor([0.1, 0.3]).double()},
    "wanders": lambda shape: {"parts": [ProcessNoise(0.01), RobustWeight(2.0)], "refresh_every": 8},
    "offset": lambda shape: {"parts": [Standardize(output_offset="learned"), RobustWeight(3.0)]},
    "all": lambda shape: {"parts": all_parts()},
}


def pair(name: str, shape: tuple[int, ...] = ()) -> list[SparseOnlineGP]:
    common = {
        "capacity": 12, "batch_shape": shape, "noise_variance": 0.1, "parts": (), "standardize": False,
        "refresh_every": 64,
    }  # fmt: skip
    made = [SparseOnlineGP(D, M, **{**common, **OPTIONS[name](shape)}) for _ in range(2)]
    made[0].engine = None
    return made


def assert_alike(
    a: SparseOnlineGP, b: SparseOnlineGP, x: torch.Tensor, largest: float, exact: float = 1e-8
) -> None:
    tolerance = 1e-3 * exact * largest  # of the targets: outliers are a thousand times what noise is
    for query in (x[0], x[-1]):  # one query per model: compiled
        for ask in ("forward", "linearize", "predict_with_jacobians"):
            torch.testing.assert_close(
                getattr(b, ask)(query), getattr(a, ask)(query), atol=tolerance, rtol=tolerance
            )
        law, other = (g.predict(query, observation=True) for g in (a, b))
        torch.testing.assert_close(other.stddev, law.stddev, atol=tolerance, rtol=tolerance)
    torch.testing.assert_close(b(x), a(x), atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("shape", [(), (3,)])
@pytest.mark.parametrize("name", OPTIONS)
def test_compiled_loops_do_what_torch_does(name, shape):
    reference, fast = pair(name, shape)
    x, y = hard_stream(140, *shape)  # caches are rebuilt after 64
    exact = 1e-6 if name == "linear" else 1e-8  # twelve points of a space of five: more is left to rounding
    for t in range(len(x)):
        a, b = reference.update(x[t], y[t]), fast.update(x[t], y[t])
        assert torch.equal(a.event, b.event), t
        for figure in ("novelty", "nis", "weight"):
            torch.testing.assert_close(getattr(b, figure), getattr(a, figure), atol=exact, rtol=exact)
    assert_alike(reference, fast, x, float(y.abs().max()), exact)
    if shape:
        mask = torch.rand(60, *shape, generator=torch.Generator().manual_seed(1)) < 0.7
        a, b = reference.update(x[:60], y[:60], mask), fast.update(x[:60], y[:60], mask)
        assert torch.equal(a.event, b.event)
        assert_alike(reference, fast, x, float(y.abs().max()), exact)


KERNELS = {
    "stationary": lambda shape: Matern32(D, batch_shape=shape),
    "shared": lambda shape: Matern32(D),
    "linear": lambda shape: LinearKernel(D, batch_shape=shape),
    "action": lambda shape: ActionLinearKernel(D, 2, batch_shape=shape),
    "deep": lambda shape: DeepKernel(Matern32(D, batch_shape=shape), hidden=(8, 6), features=3),
}


@pytest.mark.parametrize(("shape", "memory"), [((), 60), ((3,), 0), ((3,), 60)])
@pytest.mark.parametrize("name", KERNELS)
def test_compiled_steps_and_rebuilds_are_those_of_torch(name, shape, memory):
    """Hyperparameters take the same way, in parts (one model with a memory) and at once."""
    x, y = hard_stream(130, *shape)
    fades = ForgettingFactor(0.99) if memory else ProcessNoise(0.01)
    parts = [Standardize(), RobustWeight(3.0), fades, LearnHyperparameters(steps=2, memory=memory)]
    common = {"capacity": 12, "batch_shape": shape, "parts": parts, "refresh_every": 16}
    reference, fast, copied = (SparseOnlineGP(D, M, kernel=KERNELS[name](shape), **common) for _ in range(3))
    reference.engine = None
    reference.update(x, y)
    for t in range(len(x)):
        fast.update(x[t], y[t])
        copied.update(x[t], y[t])
        copied = copied if t % 3 else copy.deepcopy(copied)  # between the parts of a step, too
    for a, b, c in zip(*(one.buffers() for one in (reference, fast, copied)), strict=True):
        torch.testing.assert_close(b, a, atol=1e-5, rtol=1e-5)
        assert torch.equal(b, c)
    assert torch.equal(fast(x[0]), copied(x[0]))


@pytest.mark.parametrize("shape", [(), (3,)])
def test_compiled_units_are_those_of_torch(shape):
    generator = torch.Generator().manual_seed(0)
    gp, other = (SparseOnlineGP(D, M, parts=[Standardize()], batch_shape=shape) for _ in range(2))
    for k in range(6):
        x = torch.randn(*shape, 32, D, generator=generator, dtype=torch.float64)
        x = (x * 1e3 if k == 3 else x) * x.new_tensor([1.0, 0.0 if k == 2 else 1e-6, 1e150, 1.0])
        x[..., 7 : 9 + k, :] *= 100.0
        on = (torch.rand(*shape, 32, generator=generator) < 0.9).double()
        first = 32 * k + 5  # of a ring, whose end lies within the block
        for i in range(32):
            gp.recent.keep(first + i, x[..., i, :], x[..., i, :M], on[..., i])
        assert gp.engine.pool(gp, first + 32, 32)
        other.units.pool(x, x[..., :M], on)
        changes = gp.engine.settle(gp), (other.units.input.settle(), other.units.output.settle())
        for found, wanted in zip(*changes, strict=True):
            assert (found is None) == (wanted is None)
            torch.testing.assert_close(found, wanted, atol=1e-15, rtol=1e-7)
    for a, b in zip(gp.units.buffers(), other.units.buffers(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-15, rtol=1e-7)


class Periodic(SquaredExponential):
    pass


class Doubling(RobustWeight):
    def weigh(self, nis, mask):
        return 0.5 * super().weigh(nis, mask)


def used(gp: SparseOnlineGP, call, monkeypatch) -> bool:
    """Whether the call reached a compiled loop that worked."""
    done, loops = [], loading.load_loops()
    if loops is None:
        call()
        return False
    for name in ("update_fleet", "query_fleet"):
        loop = getattr(loops, name)
        monkeypatch.setattr(loops, name, lambda *args, loop=loop: (done.append(True), loop(*args))[1])
    call()
    monkeypatch.undo()
    return bool(done)


def test_where_torch_must_do_the_work(monkeypatch):
    x, y = hard_stream(30)
    gp = pair("plain")[1]
    gp.update(x, y)
    query = x[0]
    assert used(gp, lambda: gp(query), monkeypatch)
    assert used(gp, lambda: gp.update(x[0], y[0]), monkeypatch)
    assert not used(gp, lambda: gp(query.clone().requires_grad_(True)), monkeypatch)
    assert not used(gp, lambda: gp(x), monkeypatch)  # products are faster for many
    assert not used(gp, lambda: torch.func.vmap(gp)(x), monkeypatch)
    assert not used(gp, lambda: torch.func.jacfwd(gp)(query), monkeypatch)
    graph = torch.fx.experimental.proxy_tensor.make_fx(gp)(query)
    torch.testing.assert_close(graph(x[5]), gp(x[5]))
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(query, torch.ones_like(query))
        tangent = torch.autograd.forward_ad.unpack_dual(gp(dual)).tangent
    torch.testing.assert_close(tangent, gp.linearize(query)[1].sum(-1))
    lengthscale = gp.kernel.log_lengthscale.requires_grad_(True)
    assert gp(query).requires_grad
    lengthscale.requires_grad_(False)
    single = copy.deepcopy(gp).to(torch.float32)
    other = SparseOnlineGP(D, M, capacity=12, parts=[Doubling(3.0)])
    for learner, said in (
        (other, "its part, Doubling"),
        (single, "float64"),
        (pair("unknown")[1], "Periodic"),
    ):
        with pytest.warns(SpeedWarning, match=said):
            assert not used(learner, lambda learner=learner: learner.update(x[0], y[0]), monkeypatch)


def test_rows_that_are_not_contiguous_are_learned_as_they_are(monkeypatch):
    x, y = hard_stream(30)
    gp, other = pair("all")[1], pair("all")[1]
    apart = x.mT.contiguous().mT
    assert not apart[0].is_contiguous()
    for t in range(len(x)):
        rough = t & (t + 1) == 0  # then all are learned again in new units, by torch
        assert used(other, lambda t=t: other.update(apart[t], y[t]), monkeypatch) is not rough
        gp.update(x[t], y[t])
        assert torch.equal(gp(x[t]), other(apart[t]))


@pytest.mark.parametrize("name", ["plain", "deep"])
def test_an_answer_follows_samples_and_parameters(name):
    x, y = hard_stream(60)
    gp = pair(name)[1]
    gp.update(x[:40], y[:40])
    query = x[50].clone()
    changed = gp(query)
    torch.testing.assert_close(changed, gp(query.unsqueeze(0))[0])
    gp.update(query, y[50])
    torch.testing.assert_close(gp(query), gp(query.unsqueeze(0))[0])
    assert not torch.equal(gp(query), changed)
    next(gp.kernel.buffers()).add_(0.1)
    gp.refresh()
    torch.testing.assert_close(gp(query), gp(query.unsqueeze(0))[0])


def test_an_answer_that_was_given_away_may_be_changed():
    gp = pair("plain")[1]
    x, y = hard_stream(20)
    gp.update(x, y)
    for ask in (gp.forward, lambda q: gp.moments(q)[1], lambda q: gp.predict_with_jacobians(q)[3]):
        first = ask(x[0])
        kept = first.clone()
        first.zero_()
        assert torch.equal(ask(x[0]), kept)


def test_arrays_follow_buffers_that_are_replaced():
    x, y = hard_stream(60)
    gp = pair("all")[1]
    gp.update(x[:40], y[:40])
    copied, loaded = copy.deepcopy(gp), pair("all")[1]
    loaded.update(x[:3], y[:3])
    loaded.load_state_dict(copy.deepcopy(gp.state_dict()), assign=True)
    gp.update(x[40:], y[40:])
    for other in (copied, loaded):
        before = other(x[0]).clone()
        other.update(x[40:], y[40:])
        assert not torch.equal(other(x[0]), before)
        assert torch.equal(other(x[0]), gp(x[0]))
    gp.kernel.log_lengthscale.data = gp.kernel.log_lengthscale + 0.3
    gp.refresh()
    torch.testing.assert_close(gp(x[:1])[0], gp(x[0]), atol=1e-11, rtol=0)  # many by torch, one compiled


def test_without_numba_torch_does_it_all(monkeypatch):
    x, y = hard_stream(120)
    reference = pair("all")[0]
    reference.update(x, y)
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in [
        name for name in sys.modules if name.startswith("torch_ekm.residual.") and ".numba_" in name
    ]:
        package, _, module = name.rpartition(".")
        monkeypatch.delitem(sys.modules, name)
        monkeypatch.delattr(sys.modules[package], module)
    monkeypatch.setattr(loading, "_loader", loading.Loader())
    assert not warm_up()
    gp = pair("all")[1]
    gp.update(x, y)
    assert torch.equal(gp(x), reference(x))
    assert torch.equal(gp(x[0]), reference(x[0]))


def test_a_fresh_installation_learns_while_another_process_compiles(monkeypatch):
    class Compiler:
        result = None

        def wait(self):
            return self.result

        def poll(self):
            return self.result

    started, compiler = [], Compiler()
    monkeypatch.setattr(loading, "_is_cached", lambda: False)
    monkeypatch.setattr(subprocess, "Popen", lambda *args, **options: (started.append(args), compiler)[1])
    monkeypatch.setattr(loading, "_loader", loading.Loader())
    x, y = hard_stream(120)
    gp, reference = pair("all")[1], pair("all")[0]
    with pytest.warns(SpeedWarning, match="warm_up") as given:
        gp.update(x[:80], y[:80])
    assert given[0].filename == __file__  # a user sees their own line
    reference.update(x[:80], y[:80])
    assert torch.equal(gp(x[0]), reference(x[0]))
    assert not used(gp, lambda: gp(x[0]), pytest.MonkeyPatch())
    compiler.result = 0
    gp.update(x[80:], y[80:])
    reference.update(x[80:], y[80:])
    assert used(gp, lambda: gp(x[1]), pytest.MonkeyPatch())
    assert_alike(reference, gp, x, float(y.abs().max()))
    assert len(started) == 1


def test_loops_that_are_compiled_are_not_compiled_again():
    assert loading._is_cached()
    loops = importlib.import_module(loading._LAST)
    own = [name for name, one in vars(loops).items() if getattr(one, "__module__", "") == loops.__name__]
    assert own[-1] == loading._LAST_LOOP


def test_where_numba_can_write_no_cache_torch_does_it_all():
    code = (
        "import numba.core.caching as caching, torch; caching.CacheImpl._locator_classes = []\n"
        "from torch_ekm import SparseOnlineGP\n"
        "from torch_ekm import warm_up\n"
        "x = torch.ones(3).double(); gp = SparseOnlineGP(3, 1); gp.update(x, x[:1])\n"
        "assert not warm_up() and float(gp(x)) > 0.9"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "SpeedWarning: compiled loops are off" in done.stderr  # said once, not silent
    assert done.stderr.count("NUMBA_CACHE_DIR") == 1


def test_loops_that_another_process_takes_away_meanwhile_are_no_failure(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    (tmp_path / "loops").mkdir()
    name = f"numba_mixture.mix_fleet-1.py{sys.version_info.major}{sys.version_info.minor}.nbi"
    (tmp_path / "loops" / name).symlink_to(tmp_path / "gone")
    assert not loading._is_cached()
