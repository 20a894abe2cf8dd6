"""States and files: what they belong to is in them, and a wrong or hostile one changes and runs nothing."""

import copy
import json
import os
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import torch_ekm
from torch_ekm import exceptions
from torch_ekm.enhanced import EnhancedModel, GraspEncoding
from torch_ekm.kinematics.poses import GraspState
from torch_ekm.residual import (
    ActionLinearKernel,
    DeepKernelSOGP,
    ForgettingFactor,
    LearnHyperparameters,
    Matern32,
    MixtureResidual,
    RecursiveLeastSquares,
    ReplayMLP,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
)


def stream(n: int = 40, d: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.randn(n, d, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x, torch.sin(x[:, :2])


def sogp(**options) -> SparseOnlineGP:
    usual = {"kernel": SquaredExponential(3), "parts": [Standardize(), RobustWeight(3.0)]}
    return SparseOnlineGP(3, 2, **{"capacity": 8, **usual, **options})


LEARNERS = {
    "sogp": sogp,
    "kernel": lambda: sogp(kernel=ActionLinearKernel(3, 1, state_kernel=Matern32(2)), parts=[]),
    "matern": lambda: sogp(kernel=Matern32(3, lengthscale=2.0)),
    "deep": lambda: DeepKernelSOGP(3, 2, capacity=8, hidden=(8,), seed=3, parts=[Standardize()]),
    "learns": lambda: sogp(parts=[ForgettingFactor(0.9), LearnHyperparameters(memory=20)], refresh_every=8),
    "mixture": lambda: MixtureResidual([sogp(), RecursiveLeastSquares(3, 2)], levels=(0.0, 0.1)),
    "network": lambda: ReplayMLP(3, 2, hidden=(8,), members=2),
    "single": lambda: sogp(dtype=torch.float32),
}


def test_a_fleet_of_which_not_all_had_a_sample_comes_back(tmp_path: Path) -> None:
    x = stream(2)[0]
    fleet = SparseOnlineGP(3, 1, batch_shape=(2,))
    fleet.update(x, x[:, :1], torch.tensor([True, False]))
    torch_ekm.save(fleet, tmp_path / "fleet")
    assert torch.equal(torch_ekm.load(tmp_path / "fleet")(x), fleet(x))


@pytest.mark.parametrize("name", LEARNERS)
def test_a_file_holds_learner_and_options(name: str, tmp_path: Path) -> None:
    x, y = stream()
    learner = LEARNERS[name]()
    learner.update(x, y)
    torch_ekm.save(learner, tmp_path / "learner")
    loaded = torch_ekm.load(tmp_path / "learner")
    assert repr(loaded) == repr(learner)
    for both in (learner, loaded):
        both.update(x[:9], y[:9])
    assert torch.equal(loaded(x), learner(x))
    assert torch.equal(
        loaded.predict(x, observation=True).stddev, learner.predict(x, observation=True).stddev
    )
    assert os.listdir(tmp_path) == ["learner"]  # nothing half-written stays
    with pytest.raises(exceptions.OutputError, match="cannot be written"):
        torch_ekm.save(learner, tmp_path / "nowhere" / "learner")


def test_a_fleet_of_single_learners_and_a_learner_of_ones_own(tmp_path: Path) -> None:
    class Mine(RecursiveLeastSquares):
        def __init__(self, in_features: int, out_features: int, slope: float, **options) -> None:
            super().__init__(in_features, out_features, **options)
            self.slope = slope

    torch_ekm.save(Mine(3, 2, slope=0.5), tmp_path / "mine")
    assert torch_ekm.load(tmp_path / "mine", classes=[Mine]).slope == 0.5
    with pytest.raises(exceptions.ParameterError, match=r"passed as classes=\[Mine\]"):
        torch_ekm.load(tmp_path / "mine")
    torch.save(Mine(3, 2, slope=0.5).state_dict(), tmp_path / "state.pt")
    with pytest.raises(exceptions.FileFormatError, match=r"not written by torch_ekm\.save"):
        torch_ekm.load(tmp_path / "state.pt")
    (tmp_path / "joint.csv").write_text("x,y\n1,2\n")
    with pytest.raises(exceptions.FileFormatError, match=r"not written by torch_ekm\.save"):
        torch_ekm.load(tmp_path / "joint.csv")


def test_an_enhanced_model_with_its_encoding(tmp_path: Path) -> None:
    def f(state: GraspState, action: torch.Tensor) -> torch.Tensor:
        return action.new_zeros(2)

    double = {"dtype": torch.float64}
    reference = GraspState(torch.ones(4, **double), torch.ones(3, **double), torch.eye(3, **double))
    encode = GraspEncoding(reference, [1, 3])
    learner = SparseOnlineGP(encode.n_features + 2, 2, capacity=8)
    ekm = EnhancedModel(f, learner, encode=encode, action_scale=3.0, output_scale=torch.tensor([2.0, 5.0]))
    action, motion = torch.ones(2, **double), torch.ones(10, **double)
    for t in range(9):
        ekm.update(reference.plus(0.1 * t * motion), action * t, action * 0.3)
    torch_ekm.save(ekm, tmp_path / "ekm")
    loaded = torch_ekm.load(tmp_path / "ekm", model=f)
    state = reference.plus(0.25 * motion)
    assert torch.equal(loaded(state, action), ekm(state, action))
    with pytest.raises(exceptions.ParameterError, match="model"):
        torch_ekm.load(tmp_path / "ekm")
    other = EnhancedModel(f, copy.deepcopy(learner), encode=GraspEncoding(reference, [0, 3]))
    before = copy.deepcopy(other.learner.state_dict())
    with pytest.raises(exceptions.StateMismatchError, match=r"encode.joints\[0\]: 1 in the state, 0 here"):
        other.load_state_dict(ekm.state_dict())
    assert all(torch.equal(a, before[k]) for k, a in other.learner.state_dict().items() if torch.is_tensor(a))
    with pytest.raises(exceptions.NoStateError, match="encode"):
        torch_ekm.save(EnhancedModel(f, learner, encode=lambda s: s), tmp_path / "none")


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (lambda: sogp(capacity=9), "capacity: 8 in the state, 9 here"),
        (lambda: sogp(kernel=Matern32(3)), "kernel: SquaredExponential in the state, Matern32 here"),
        (lambda: sogp(parts=[RobustWeight(3.0)], standardize=False), "parts"),
        (lambda: sogp(parts=[Standardize(), RobustWeight(2.0)]), r"parts\[1\].threshold: 3.0 in the state"),
        (lambda: sogp(novelty_threshold=1e-3), "novelty_threshold"),
        (lambda: sogp(dtype=torch.float32), "dtype: float64 in the state, float32 here"),
        (lambda: SparseOnlineGP(4, 2, capacity=8), "in_features: 3 in the state, 4 here"),
        (lambda: RecursiveLeastSquares(3, 2), "SparseOnlineGP in the state, RecursiveLeastSquares here"),
    ],
)
def test_a_state_of_another_learner_is_refused_by_name(other, named: str) -> None:
    x, y = stream()
    state = sogp()
    state.update(x, y)
    learner = other()
    tree = torch.nn.Sequential(learner)  # wherever it stands
    with pytest.raises(exceptions.StateMismatchError, match=named):
        learner.load_state_dict(state.state_dict())
    with pytest.raises(exceptions.StateMismatchError, match=named):
        tree.load_state_dict({f"0.{name}": one for name, one in state.state_dict().items()})


def leaves(value, path=()):
    """All that is in a state, with the way to it."""
    if isinstance(value, dict):
        for key in value:
            if key != "made_with":
                yield from leaves(value[key], (*path, key))
    else:
        yield path, value


def hostile_values(value):
    if not isinstance(value, torch.Tensor):
        yield from ("x", None, -5, 10**400, [1], {}, float("nan"))
        return
    yield from ("x", None, value.new_zeros((*value.shape, 2)), value.to(torch.complex64))
    if value.is_floating_point() and value.numel():
        yield from (torch.full_like(value, number) for number in (float("nan"), float("inf")))
    elif value.dtype == torch.int64 and value.numel():
        yield torch.full_like(value, -7)


@pytest.mark.parametrize("name", ["sogp", "learns", "mixture"])
def test_a_state_is_loaded_whole_or_not_at_all(name: str) -> None:
    """Each of its entries in turn is a hostile one."""
    make = LEARNERS[name]
    x, y = stream()
    other, learner = make(), make()
    other.update(x[:20], y[:20])
    learner.update(x[20:], y[20:])
    state, before, mean = other.state_dict(), copy.deepcopy(learner.state_dict()), learner(x)
    paths = list(leaves(state))
    for path, value in paths[:: max(len(paths) // 40, 1)]:
        for bad in hostile_values(value):
            if torch.is_tensor(bad) and torch.is_tensor(value) and torch.equal(bad, value):
                continue  # a limit at infinity
            hostile = copy.deepcopy(state)
            inner = hostile
            for key in path[:-1]:
                inner = inner[key]
            inner[path[-1]] = bad
            with pytest.raises(exceptions.StateMismatchError):
                learner.load_state_dict(hostile)
    for made in ({}, [], {"class": "SparseOnlineGP"}, None):
        hostile = {**state, "_extra_state": {**state["_extra_state"], "made_with": made}}
        with pytest.raises(exceptions.StateMismatchError):
            learner.load_state_dict(hostile)
    after = dict(leaves(learner.state_dict()))
    for path, value in leaves(before):
        assert torch.equal(value, after[path]) if torch.is_tensor(value) else value == after[path], path
    assert torch.equal(learner(x), mean)


@pytest.mark.parametrize(
    ("name", "ends", "value", "said"),
    [
        # compiled loops write where counts lead
        ("sogp", "posterior.slot", 10**12, "posterior"),
        ("sogp", "posterior.count", 9, "posterior"),
        ("sogp", "posterior.count", 1, "posterior"),
        ("sogp", "posterior.slot", 7, "posterior"),
        ("sogp", "posterior.active", 1.0, "posterior"),
        # what is stated would be NaN, or turned round
        ("mixture", "output.scale", 0.0, "scale is not above 0"),
        ("mixture", "output.scale", -1.0, "scale is not above 0"),
        # factors of these, with the other sign, would be NaN
        ("sogp", "posterior.moments", None, "negative in some direction"),
        ("mixture", "1.information", None, "negative in some direction"),
    ],
)
def test_a_state_to_which_no_stream_leads_is_refused(name, ends, value, said) -> None:
    x, y = stream()
    learner, other = LEARNERS[name](), LEARNERS[name]()
    other.update(x[:4], y[:4])
    state = other.state_dict()
    entries = [key for key in state if key.endswith(ends)]
    assert entries
    for entry in entries:
        hostile = -state[entry] if value is None else torch.full_like(state[entry], value)
        with pytest.raises(exceptions.StateMismatchError, match=said):
            learner.load_state_dict({**state, entry: hostile})
    assert not learner(x).any()


def test_flipped_bits_and_cuts_of_a_file(tmp_path: Path) -> None:
    x, y = stream()
    learner, path = sogp(), tmp_path / "learner"
    learner.update(x, y)
    torch_ekm.save(learner, path)
    whole, draw = path.read_bytes(), random.Random(0)
    refused = 0
    for _ in range(150):
        bit = draw.randrange(8 * len(whole))
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            read = torch_ekm.load(path)
        except exceptions.EKMError:
            refused += 1
        else:  # a date, say, which nobody reads
            assert torch.equal(read(x), learner(x))
    assert refused > 100
    for _ in range(30):
        path.write_bytes(whole[: draw.randrange(len(whole))])
        with pytest.raises(exceptions.FileFormatError):
            torch_ekm.load(path)


def test_what_only_starts_a_state_may_differ() -> None:
    x, y = stream()
    learner, other = sogp(noise_variance=0.3), sogp(kernel=SquaredExponential(3, variance=4.0))
    other.engine = None
    learner.update(x, y)
    other.load_state_dict(learner.state_dict())
    torch.testing.assert_close(other(x), learner(x), atol=0, rtol=0)


class Runs:
    """Unpickling this leaves a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def rewritten(path: Path, header=None, **entries: bytes) -> Path:
    with zipfile.ZipFile(path) as archive:
        kept = {name: archive.read(name) for name in archive.namelist()}
    if header is not None:
        read = json.loads(kept["header.json"])
        header(read)
        kept["header.json"] = json.dumps(read).encode()
    other = path.with_suffix(".bad")
    with zipfile.ZipFile(other, "w") as archive:
        for name, content in {**kept, **entries}.items():
            archive.writestr(name, content)
    return other


def test_hostile_and_damaged_files(tmp_path: Path) -> None:
    path, ran = tmp_path / "learner", tmp_path / "ran"
    torch_ekm.save(sogp(), path)
    np.save(tmp_path / "a.npy", np.array([Runs(ran)], dtype=object), allow_pickle=True)
    pickled = (tmp_path / "a.npy").read_bytes()

    def rename(name):
        return lambda header: header["made_with"].update({"class": name})

    def resize(header):
        header["made_with"]["arguments"]["capacity"] = 10**15

    bad = [
        rewritten(path, **{"0.npy": pickled}),
        rewritten(path, **{"header.json": b"[" * 100_000}),
        rewritten(path, rename("system")),
        rewritten(path, rename("GraspState")),
        rewritten(path, resize),
        rewritten(path, lambda header: header["state"].pop("pending")),
        rewritten(path, lambda header: header.update(format="another")),
    ]
    (tmp_path / "cut").write_bytes(path.read_bytes()[:2000])
    torch.save({"a": Runs(ran)}, tmp_path / "torch")
    for file in (*bad, tmp_path / "cut", tmp_path / "torch"):
        with pytest.raises(exceptions.EKMError):
            torch_ekm.load(file)
    assert not ran.exists()
    with pytest.raises(exceptions.FileFormatError, match="no such file"):
        torch_ekm.load(tmp_path / "nowhere")


def test_another_librarys_objects_are_not_saved(tmp_path: Path) -> None:
    from torch_ekm.interop import RiverResidual

    learner = RiverResidual(3, 2)
    with pytest.raises(exceptions.NoStateError, match="river"):
        torch_ekm.save(learner, tmp_path / "river")
    state = torch.frombuffer(bytearray(b"cos\nsystem\n"), dtype=torch.uint8)
    with pytest.raises(exceptions.EKMError):
        learner.load_state_dict({"_extra_state": state, "noise": learner.noise})
