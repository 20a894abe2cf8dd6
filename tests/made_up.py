"""A trial that was never run: what every sensor said, with raw counts, an image and events."""

from typing import Any

import torch

from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation, PlantStatus, Trajectory, Truth


def trajectory(seed: int, n: int = 3, n_a: int = 2) -> Trajectory:
    """Four joints, n commands, readings at 0.3 s, 0.4, 0.7, ...; the object is lost at the end."""
    random = torch.Generator().manual_seed(seed)

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    seen = []
    for k in range(n + 1):
        image = torch.full((9, 8, 3), k).byte()
        info: dict[str, Any] = {
            "raw": {"counts": torch.arange(4, dtype=torch.int32) + k, "image": image},
            "estimate": {"covariance": some(2, 2).float()},
        }
        if k == 1:
            info["events"] = ("a tendon slipped",)
        q, a, position, rotation = some(4), some(n_a), some(3), exp(some(3))
        status = PlantStatus.LOST if k == n else PlantStatus.HELD
        truth = Truth(q + 0.01, position, rotation)
        reading = q, a, position, rotation, some(2), 0.1 * k**2 + 0.3
        seen.append(Observation(*reading, status, info, truth))
    return Trajectory(seed, [some(n_a) for _ in range(n)], seen, {"note": "made up"})
