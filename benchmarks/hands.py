"""Simulated hands, each by what it changes in a setting: "nominal" with one thing other, and mixtures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch_ekm.simulation import ENGINES, PlantConfig, PlantParameters, preset

_DEG = math.pi / 180
_G = 9.81  # [m/s^2]
Hand = Mapping[str, Any]

STRENGTHS = ("weak", "medium", "strong")
#: Ways in which a plant departs from its description: the plant's figures at the three strengths.
FAMILIES: dict[str, tuple[dict[str, Any], ...]] = {
    "arms": tuple({"arm_variation": v, "arm_phase": math.pi} for v in (0.1, 0.2, 0.3)),
    "springs_stiffen": tuple({"spring_stiffening": s} for s in (0.25, 0.5, 1.0)),
    "springs_sag": tuple({"spring_stiffening": s} for s in (-0.1, -0.2, -0.3)),
    "cable_friction": tuple({"cable_friction": c} for c in (0.05, 0.1, 0.2)),
    "tendon_coupling": tuple({"tendon_coupling": c} for c in (0.05, 0.1, 0.2)),
    "soft_pads": tuple({"contact_stiffness": k} for k in (2e4, 1e4, 5e3)),
    "joint_play": tuple({"joint_play": p * _DEG} for p in (0.5, 1.0, 2.0)),
    "uneven_friction": tuple({"friction_unevenness": u} for u in (0.1, 0.25, 0.4)),
    "fingertip_scale": tuple({"force_scale": s} for s in (1.25, 1.5, 2.0)),
    "fingertip_drift": tuple({"force_drift": d} for d in (0.02, 0.05, 0.1)),
    "hysteresis": tuple({"hysteresis": h} for h in (0.03, 0.06, 0.1)),
}


def _hand(plant: PlantParameters, **changes: Any) -> Hand:
    """A dead joint sensor is known as such from the Hall sensors' calibration only."""
    return {"plant": plant, **({"sensing": True} if plant.stuck_joints else {}), **changes}


def _nominal(**figures: Any) -> Hand:
    return _hand(preset("nominal").replace(**figures))


#: One strength each. "odd_hand" and "odd_other" are the same for every hardware instance.
OTHERS: dict[str, Hand] = {
    "nominal": _nominal(),
    "worn": _hand(preset("worn")),
    "odd_hand": _nominal(arm_variation=0.25, spring_stiffening=0.5),
    "odd_other": _nominal(arm_variation=-0.25, spring_stiffening=-0.3),
    **{name: _hand(preset(name)) for name in ("odd_1", "odd_2", "odd_3", "odd_4", "odd_5", "hostile")},
    "low_friction": _nominal(friction=0.4),
    "no_fingertips": _nominal(force_sensors=False),
}
#: Hands that lose objects: on others no part of a plan shows its worth.
LOSING: dict[str, Hand] = {
    "fingertips x 2": _nominal(force_scale=2.0),
    "friction 0.4": OTHERS["low_friction"],
    "odd 4": OTHERS["odd_4"],
}
#: Factors on the description's friction and mass (each pair), one other change at a time.
CONDITIONS: dict[str, Hand] = {
    **{
        f"friction {f:g}, mass {m:g}": _nominal(friction=f, mass=m)
        for f, m in itertools.product((0.4, 0.6, 0.8, 1.0, 1.2), (0.5, 1.0, 2.0, 3.0))
    },
    **{f"size {scale:g}": _nominal(object_scale=scale) for scale in (0.85, 1.15)},
    **{
        name: {"config": PlantConfig(gravity=gravity)}
        for name, gravity in {
            "fingers down": (_G, 0.0, 0.0), "fingers up": (-_G, 0.0, 0.0),
            "index down": (0.0, -_G, 0.0), "index up": (0.0, _G, 0.0),
        }.items()
    },
    "left hand": {"hand": "icub_left"},
    "centred grasps": {"config": PlantConfig(spread=0.0)},
}  # fmt: skip
#: Without faults and noise.
DESCRIBED: dict[str, Hand] = {
    f"described in {label}": _hand(preset("none"), engine=engine) for engine, label in ENGINES.items()
}
#: Presets in both engines.
IN_ENGINES: dict[str, Hand] = {
    f"{name} in {label}": {**OTHERS[name], "engine": engine}
    for name in ("nominal", "worn")
    for engine, label in ENGINES.items()
}


def hands(names: Sequence[str]) -> dict[str, Hand]:
    """Hands by name: "FAMILY", "FAMILY:STRENGTH", of OTHERS, LOSING or CONDITIONS; "all", "strong".

    Raises:
        SystemExit: no such hand; the message lists them.
    """
    known = {**OTHERS, **LOSING, **CONDITIONS, **IN_ENGINES, **DESCRIBED}
    groups = {
        "all": [*FAMILIES, *OTHERS],
        "strong": [*(f"{name}:strong" for name in FAMILIES), *OTHERS],
        "losing": [*LOSING],
        "conditions": [*CONDITIONS],
        "engines": [*IN_ENGINES],
        "described": [*DESCRIBED],
    }
    found: dict[str, Hand] = {}
    for name in itertools.chain.from_iterable(groups.get(name, [name]) for name in names):
        family, _, only = name.partition(":")
        if name in known:
            found[name] = known[name]
        elif family in FAMILIES:
            for strength, figures in zip(STRENGTHS, FAMILIES[family], strict=True):
                if only in ("", strength):
                    found[f"{family}:{strength}"] = _nominal(**figures)
        else:
            raise SystemExit(f"'{name}' is no hand: {', '.join((*groups, *FAMILIES, *known))}")
    return found
