"""What tests of the model share."""

import pytest
from model_toys import Toy, three_finger


@pytest.fixture(scope="module")
def toy() -> Toy:
    """Three fingers, rigid tendons, at rest; no test changes them."""
    return three_finger()
