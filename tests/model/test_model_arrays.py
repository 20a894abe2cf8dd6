"""One state is computed in numpy, batches and derivatives in torch, by the same equations."""

from __future__ import annotations

import dataclasses
import functools

import pytest
import torch
from model_icub import GRASPS
from model_toys import F64, batch_of, stacked


def assert_same(one, many, names=None):
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(many, field.name)
        if isinstance(a, torch.Tensor) and (names is None or field.name in names):
            message = functools.partial("{}: {}".format, field.name)
            torch.testing.assert_close(a, b[0], rtol=1e-10, atol=1e-10, msg=message)


@pytest.mark.parametrize("name", GRASPS)
def test_a_state_in_numpy_is_the_state_in_torch(name) -> None:
    model, state, contacts = GRASPS[name]()
    n_a = model.hand.n_a
    da = 0.01 * torch.arange(1, n_a + 1).to(F64)
    batch = batch_of(state), stacked(contacts)  # which torch computes
    one, many = model.linearize(state, contacts), model.linearize(*batch)
    for _ in range(2):  # with nothing known of the forces, and with those that are expected
        assert one.forces.status == many.forces.status
        assert [doubt.kind for doubt in one.doubts] == [doubt.kind for doubt in many.doubts]
        assert_same(one.forces, many.forces)
        fields = {field.name for field in dataclasses.fields(one)} - {"described"}
        assert_same(one, many, fields)
        assert_same(one.forces_after(da), many.forces_after(da[None]))
        torch.testing.assert_close(one.margins_after(da), many.margins_after(da[None])[0], rtol=0, atol=1e-10)
        expected = one.forces_after(0 * da)
        one = model.linearize(state, contacts, expected=expected, previous=one)
        many = model.linearize(*batch, expected=expected, previous=many)
