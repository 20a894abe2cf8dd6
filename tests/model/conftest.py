"""What tests of the model share."""

from __future__ import annotations

import pytest
import qpsolvers
from model_toys import Toy, three_finger


@pytest.fixture(scope="module")
def toy() -> Toy:
    """Three fingers, rigid tendons, at rest; no test changes them."""
    return three_finger()


@pytest.fixture
def exact_force_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    """PIQP's usual tolerance leaves 3e-4 of the weakest direction: finite differences need it tighter."""
    solve = qpsolvers.solve_problem

    def tight(problem, solver, **options):
        options |= {"eps_abs": 1e-13, "eps_rel": 1e-13} if solver == "piqp" else {}
        return solve(problem, solver, **options)

    monkeypatch.setattr(qpsolvers, "solve_problem", tight)
