"""SAPIEN, imported in one place and set up for things of the size of a hand."""

from __future__ import annotations

import warnings
from types import ModuleType
from typing import Any

from ..._extras import require

_TOLERANCE_LENGTH = 0.02  # [m] size of the things simulated; PhysX's defaults are for furniture
_TOLERANCE_SPEED = 0.1  # [m/s]
_CONTACT_OFFSET = 0.0005  # [m]; at the default 10 mm friction acts on points that do not touch

_engine: Any = None  # PhysX allows one engine in a process and drops it with its last reference


def sapien() -> ModuleType:
    """The module ``sapien``, with its engine made for small things.

    SAPIEN warns at import when the system has no Vulkan; the scenes here have no renderer, so that
    warning is kept quiet.

    Raises:
        MissingExtraError: sapien is not installed.
    """
    global _engine
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*[Vv]ulkan.*")
        module = require("sapien")
    if _engine is None:
        _engine = module.physx.PhysxEngine(_TOLERANCE_LENGTH, _TOLERANCE_SPEED)
    return module


def new_scene(gravity: tuple[float, float, float], time_step: float) -> Any:
    """An empty scene on CPU physics, without a renderer.

    The solver is PGS: TGS applies gravity once per step but drives once per sub-iteration, which
    shifts equilibria by about ``dt^2 k / I``.
    """
    module = sapien()
    physx = module.physx
    config = physx.get_scene_config()
    config.gravity = gravity
    config.enable_tgs = False
    config.enable_pcm = True
    config.enable_enhanced_determinism = True
    config.bounce_threshold = 0.05
    physx.set_scene_config(config)
    shape = physx.get_shape_config()
    shape.contact_offset, shape.rest_offset = _CONTACT_OFFSET, 0.0
    physx.set_shape_config(shape)
    body = physx.get_body_config()
    body.sleep_threshold = 0.0
    body.solver_position_iterations, body.solver_velocity_iterations = 16, 1
    physx.set_body_config(body)
    system = physx.PhysxCpuSystem()
    system.timestep = time_step
    return module.Scene([system])
