"""The benchmark on public records: what it measures is what the protocols say."""

from __future__ import annotations

import numpy as np
import pytest

from torch_ekm import ZeroResidual

pytest.importorskip("river", reason="extra 'interop'")
public_streams = pytest.importorskip(
    "public_streams", reason="the benchmarks are not part of this installation"
)


def test_progressive_error_from_nothing_and_intervals_over_the_range() -> None:
    random = np.random.default_rng(0)
    x, y = random.random((1200, 2)), 10.0 + random.normal(size=1200)
    first, whole = public_streams.fried("zero", lambda d, m: ZeroResidual(d, m, noise_variance=1.44), x, y)
    error = y - y[0]  # it says the first target ever after
    error[0] = y[0]  # before which it says 0
    assert (first.stream, first.samples) == ("Fried, first 1000", 1000)
    assert (whole.stream, whole.samples) == ("Fried", 1200)
    assert first.rmse == pytest.approx(np.sqrt(np.square(error[:1000]).mean()))
    assert whole.mae == pytest.approx(np.abs(error).mean())
    half = 1.959963984540054 * 1.2
    assert whole.coverage == pytest.approx((np.abs(error[1:]) <= half).sum() / 1200)
    assert whole.width == pytest.approx(2 * half * 1199 / 1200 / np.ptp(y), rel=1e-6)


def test_tables_hold_ours_beside_what_was_published() -> None:
    rows = [
        public_streams.Row("Fried", "default", 9, 1.0, 1.1, 2.0, 0.95, 0.17),
        public_streams.Row("TrumpApproval", "default", 9, 0.2, 0.34, 2.0),
    ]
    trump, fried = public_streams.tables(rows)
    assert fried.text()[0] == ["**default**", "1", "1.1", "95.0", "17.0", "2.00", "here"]
    assert fried.text()[1][:3] == ["kNN (best), published", "-", "2.72"]
    assert trump.caption == "TrumpApproval (9 samples)"


def test_rivers_track_is_scored_by_river() -> None:
    from river import datasets, dummy, stats

    row = public_streams.track("TrumpApproval", "mean", dummy.StatisticRegressor(stats.Mean()), 50)
    y = np.array([target for _, target in datasets.TrumpApproval().take(50)])
    before = np.concatenate([[0.0], np.cumsum(y)[:-1] / np.arange(1, 50)])
    assert row.rmse == pytest.approx(np.sqrt(np.square(y - before).mean()))
