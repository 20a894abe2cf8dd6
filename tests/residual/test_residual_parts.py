"""The protocol of a learner's parts: order, copies, reset, reload, masks, and what does not go together."""

import copy
import threading
import time
from collections.abc import Iterable

import pytest
import torch
from as_published import sogp
from torch import nn

from torch_ekm.exceptions import ParameterError
from torch_ekm.residual import (
    CalibrateNoise,
    DeepKernelSOGP,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    MixtureResidual,
    Part,
    ProcessNoise,
    RobustWeight,
    SparseOnlineGP,
    Standardize,
)
from torch_ekm.residual.sparse_gp.engine.compiled import CompiledEngine

PARTS = {
    "forgetting factor": [ForgettingFactor(0.9)],
    "process noise": [ProcessNoise(0.05)],
    "robust weight": [RobustWeight(1.0)],
    "standardize": [Standardize()],
    "calibrate noise": [CalibrateNoise()],
    "detect changes": [DetectChanges()],
    "hyperparameters": [LearnHyperparameters(rate=0.1)],
    "hyperparameters with a memory": [LearnHyperparameters(rate=0.1, steps=2, memory=15)],
    "all": [
        RobustWeight(3.0),
        CalibrateNoise(),
        DetectChanges(),
        ForgettingFactor(0.98),
        Standardize(),
        LearnHyperparameters(memory=15),
    ],
    "all that go with process noise": [
        RobustWeight(3.0),
        CalibrateNoise(),
        DetectChanges(),
        ProcessNoise(0.05),
        Standardize(),
        LearnHyperparameters(),
    ],
}
every_part = pytest.mark.parametrize("name", PARTS)


def learner(parts: Iterable[nn.Module], **options) -> SparseOnlineGP:
    return sogp(3, 2, **{"capacity": 10, "refresh_every": 8, "parts": parts, **options})


def stream(n: int, *shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Off centre, in other units, with outliers; another system from the middle on."""
    generator = torch.Generator().manual_seed(0)
    x = 3.0 + 2.0 * torch.randn(n, *shape, 3, generator=generator, dtype=torch.float64)
    y = 5.0 * torch.sin(x[..., :2])
    y[n // 2 :] *= -1.0
    y[::7] += 20.0
    return x, y


def said(g: SparseOnlineGP, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return g(x), g.predict(x, observation=True).stddev


def same(a: SparseOnlineGP, b: SparseOnlineGP, x: torch.Tensor) -> bool:
    return all(torch.equal(one, other) for one, other in zip(said(a, x), said(b, x), strict=True))


@every_part
def test_a_part_makes_a_difference(name):
    x, y = stream(60)
    plain, other = learner([]), learner(PARTS[name])
    for g in (plain, other):
        g.update(x, y)
    assert not same(plain, other, x)


@every_part
def test_one_specification_serves_several_learners(name):
    x, y = stream(60)
    parts = PARTS[name]
    one, two = learner(parts), learner(parts)
    one.update(x, y)
    fresh = learner(parts)
    assert same(two, fresh, x)
    two.update(x, y)
    assert same(two, one, x)
    assert not any(list(part.buffers()) for part in parts)  # what was given is a specification still
    again = learner(one.parts)  # and so are the parts of a learner that has learned
    assert same(again, fresh, x)
    again.update(x, y)
    assert same(again, one, x)
    mixture = MixtureResidual([learner(parts), learner(parts)])
    mixture.update(x, y)
    assert torch.equal(mixture.members[0](x), mixture.members[1](x))


@every_part
def test_a_copy_goes_on_with_the_same_bits_whenever_it_is_made(name):
    x, y = stream(60)
    whole, first = learner(PARTS[name]), learner(PARTS[name])
    whole.update(x, y)
    done = 0
    for moment in (0, 1, 5, 8, 13, 29, 38, 47):
        if moment:
            first.update(x[done:moment], y[done:moment])
        done, reloaded = moment, learner(PARTS[name])
        reloaded.load_state_dict(first.state_dict())
        copies = [reloaded]
        if moment in (5, 29):  # these are made otherwise, of the same buffers
            copies += [copy.deepcopy(first), copy.deepcopy(first).to(torch.float64)]
        for g in copies:
            assert same(g, first, x), moment
            g.update(x[moment:], y[moment:])
            assert same(g, whole, x), moment


@every_part
def test_reset_is_a_fresh_start(name):
    x, y = stream(60)
    g, fresh = learner(PARTS[name]), learner(PARTS[name])
    g.update(x, y)
    with torch.no_grad():  # hyperparameters stay, by contract
        for mine, theirs in zip(
            *([*one.kernel.buffers(), one.log_noise_variance] for one in (g, fresh)), strict=True
        ):
            theirs.copy_(mine)
    g.reset()
    assert same(g, fresh, x)
    for one in (g, fresh):
        one.update(x, y)
    assert same(g, fresh, x)


@every_part
def test_models_of_a_fleet_do_not_touch_each_other(name):
    """The rhythm is the fleet's: so a single model is given the same mask, and a sample of another one."""
    x, y = stream(60, 2)
    mask = torch.rand(60, 2, generator=torch.Generator().manual_seed(3)) < 0.6
    mask[:, 1] |= ~mask[:, 0]  # in each step one of them has a sample, so that no step is left out
    both, alone = (learner(PARTS[name], batch_shape=(2,)) for _ in range(2))
    both.update(x, y, mask)
    alone.update(x, torch.stack([y[:, 0], -y[:, 1]], 1), mask)
    torch.testing.assert_close(both(x)[:, 0], alone(x)[:, 0], rtol=0, atol=0)
    assert not torch.equal(both(x)[:, 1], alone(x)[:, 1])
    silent = learner(PARTS[name], batch_shape=(2,))
    silent.update(x, y, mask & torch.tensor([False, True]))
    assert bool((silent(x)[:, 0] == 0).all())
    garbage = x.where(mask.unsqueeze(-1), torch.nan)
    other = learner(PARTS[name], batch_shape=(2,))
    other.update(garbage, y, mask)
    assert same(other, both, x)


@pytest.mark.parametrize("name", ["robust weight", "calibrate noise", "detect changes"])
def test_a_model_with_masks_is_that_of_its_own_samples(name):
    """Those parts have no clock; what happens at a rebuild comes at the fleet's step."""
    x, y = stream(120, 2)
    mask = torch.rand(120, 2, generator=torch.Generator().manual_seed(3)) < 0.6
    fleet = learner(PARTS[name], batch_shape=(2,), refresh_every=10**6)
    fleet.update(x, y, mask)
    for i in range(2):
        single = learner(PARTS[name], refresh_every=10**6)
        single.update(x[mask[:, i], i], y[mask[:, i], i])
        for a, b in zip(said(fleet, x), said(single, x[:, i]), strict=True):
            torch.testing.assert_close(a[:, i], b, atol=1e-10, rtol=0)


class _Spy(Part):
    def __init__(self, calls: list[str], name: str) -> None:
        super().__init__()
        self.calls, self.name = calls, name

    def __deepcopy__(self, memo: dict):
        return type(self)(self.calls, self.name)

    def bind(self, learner):
        self.calls.append(f"{self.name} bind")

    def weigh(self, nis, mask):
        self.calls.append(f"{self.name} weigh")
        return torch.full_like(nis, 0.5)

    def after_update(self, learner, sample):
        self.calls.append(f"{self.name} after_update {learner.n_samples}")
        return False

    def on_rebuild(self, learner):
        self.calls.append(f"{self.name} on_rebuild {int(learner.pending)}")

    def after_rebuild(self, learner):
        self.calls.append(f"{self.name} after_rebuild {int(learner.pending)}")

    def forget(self, models):
        self.calls.append(f"{self.name} forget")

    def reset(self):
        self.calls.append(f"{self.name} reset")


class _OtherSpy(_Spy):
    pass


def test_parts_are_called_in_their_order():
    calls: list[str] = []
    g = learner([_Spy(calls, "a"), _OtherSpy(calls, "b")], refresh_every=2)
    x, y = stream(2)
    g.update(x, y)
    once = ["weigh", "after_update {}"]
    expected = ["a bind", "b bind"]
    for n in range(2):
        expected += [f"{who} {what}".format(n) for what in once for who in "ab"]
    expected += [f"{who} {what}" for what in ("on_rebuild 2", "after_rebuild 0") for who in "ab"]
    assert calls == expected
    calls.clear()
    g.reset()
    assert calls == ["a reset", "b reset"]


def test_weights_multiply():
    x, y = stream(3)
    g = learner([_Spy([], "a"), RobustWeight(1e-3)])
    report = g.update(x, y)
    torch.testing.assert_close(report.weight, 0.5 * 1e-6 / report.nis, rtol=1e-12, atol=0)


class _Cautious(Part):
    """A part of somebody else's: twice the noise, half the trust, a rebuild after each sample."""

    def weigh(self, nis, mask):
        return torch.full_like(nis, 0.5)

    def after_update(self, learner, sample):
        return True

    def noise(self, variance):
        return 4.0 * variance


def test_a_part_of_ones_own():
    x, y = stream(40)
    g = learner([_Cautious()], refresh_every=10**6)
    report = g.update(x, y)
    assert bool((report.weight == 0.5).all())
    rebuilt = copy.deepcopy(g)
    rebuilt.refresh()
    assert same(g, rebuilt, x)
    assert torch.equal(g.noise_variance, 4.0 * g.log_noise_variance.exp())


def test_a_change_clears_what_parts_kept():
    calls: list[str] = []
    parts: list[Part] = [DetectChanges(), _Spy(calls, "a")]
    x, y = stream(60)
    g = learner(parts, noise_variance=1e-4)
    g.update(x, y)
    assert "a forget" in calls


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([LearnHyperparameters(), RobustWeight(3.0)], "LearnHyperparameters last"),
        ([LearnHyperparameters(), DetectChanges()], "LearnHyperparameters last"),
        ([ForgettingFactor(0.9), ForgettingFactor(0.99)], "one ForgettingFactor at most"),
        ([ProcessNoise(0.01), LearnHyperparameters(memory=10)], "0 with ProcessNoise"),
        ([ForgettingFactor], "list of parts such as"),
        (["forgetting"], "list of parts such as"),
        (RobustWeight(3.0), "list of parts such as"),
        (3.0, "list of parts such as"),
    ],
)
def test_what_does_not_go_together_is_told(parts, message):
    for kind in (SparseOnlineGP, DeepKernelSOGP):
        with pytest.raises(ParameterError, match=message):
            kind(3, 2, parts=parts)


def test_a_learner_tells_its_parts():
    text = repr(learner(PARTS["all"]))
    for told in ("RobustWeight(threshold=3.0)", "ForgettingFactor(factor=0.98)", "memory=15"):
        assert told in text
    assert learner(PARTS["all"]).part(ForgettingFactor).factor == 0.98  # type: ignore[union-attr]
    assert learner([]).part(ForgettingFactor) is None
    bare = repr(SparseOnlineGP(3, 1))
    assert "0 of 100 basis vectors" in bare
    assert "ProcessNoise(share=0.001)" in bare


def test_at_most_a_dozen_arguments():
    import inspect

    every_learner = {"self", "in_features", "out_features", "options"}
    assert len(set(inspect.signature(SparseOnlineGP.__init__).parameters) - every_learner) <= 12


class OneAtATime(Part):
    """Sleeps in the middle of an update and counts who else is there."""

    def bind(self, learner):
        self.inside = self.most = 0

    def after_update(self, learner, sample):
        self.inside += 1
        self.most = max(self.most, self.inside)
        time.sleep(1e-3)
        self.inside -= 1
        return False


@pytest.mark.parametrize("engine", [CompiledEngine, lambda: None])
def test_updates_of_two_threads_come_one_after_the_other(engine):
    gp = SparseOnlineGP(3, 2, capacity=8, parts=[OneAtATime()])
    gp.engine = engine()
    x = torch.randn(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def work():
        for row in x:
            gp.update(row, row[:2])

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert gp.n_samples == 80
    assert gp.part(OneAtATime).most == 1
    with copy.deepcopy(gp).lock, gp.lock:  # each has its own, and its holder may update
        gp.update(x, x[:, :2])
