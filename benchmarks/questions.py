"""What is asked of the matrix: plants, objects, contenders, what a session does, and what answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from contenders import (
    BEGINNINGS,
    ORACLE,
    PARTS,
    PLACE,
    PLAIN,
    PLANS,
    PRINTED,
    READINGS,
    WHOLE_TURNS,
    Contender,
)
from matrix import Frame, Question, bands_table, learning_picture, points, table
from sessions import TARGETS, directions, foresight, there_and_back, turns
from slides import errors_picture, errors_table, slides, told

from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.protocols.generalize import ENDS, TABLE_I, paper_table, significance_table
from torch_ekm.experiments.reporting.report import Table
from torch_ekm.experiments.reporting.tables import controller_table, reason_table
from torch_ekm.experiments.runner import new_objects

_ANGLES = (9.0, 19.0, 27.0)  # [deg] from fresh grasps
_WARM_UP: dict[str, Any] = {"learns_by": 3}  # turns of the E-KM before those that count
_TO_THE_END = {"angles": None, **_WARM_UP}  # shares of each object's workspace, as in the paper's Table I
BY_HAND = {"angles": _ANGLES, **_WARM_UP}
_FIRST = ("turns", "lost", "reached", "motions", "first motion [deg]", "error [deg]", "other ends")
_ENDS = ("turns", "lost", "reached", "motions", "error [deg]", "other ends")
_MOVEMENTS = ("turns", "lost", "reached", "turning movements", "motions", "seconds", "error [deg]")
#: The camera has 20 Hz and is 0.05 s late.
_CAMERA = {"frame_rate": 20.0, "latency": 0.05}
#: True errors that are called near a focused pose.
_WITHIN = {"deg": 0.25, "mm": 0.2}
_SEEN = Setting(sensing=True)


def _ends(trials: Frame) -> Table:
    """How far off the axis turns end, and how those ended that did not reach the target."""
    turned = trials[trials["kind"] == "turn"]
    columns = ("first motion [deg]", "off the axis, largest [deg]", "other ends")
    return table(turned, "contender", columns, "ends", "Ends of the turns")


def _first(trials: Frame) -> Table:
    """The first turn of a hand of which nothing is known."""
    first = trials[trials["kind"] == "first"]
    return table(
        first, "contender", _MOVEMENTS, "first", "The first turn of a hand of which nothing is known"
    )


_WHOLE_TURN = Question(
    "whole_turn", "Whole turns: with a plan and without, f and g", turns, WHOLE_TURNS,
    hands=("nominal", "losing"), objects=("box", "can", "bottle"), plant=_CAMERA, columns=_MOVEMENTS,
    options={"angles": _ANGLES, "learns_by": (14.0, -8.0, 22.0), "all_learn": True},
    more=(_first, _ends, bands_table), short={"angles": (5.0,), "learns_by": (4.0,)},
)  # fmt: skip
_ASKED = (
    Question(
        "generalize", "Every object by shares of its workspace, every controller", turns, PLAIN,
        objects=(*TABLE_I, *ENDS), setting=_SEEN, options=_TO_THE_END, columns=(), split="object",
        more=(controller_table, reason_table, paper_table, significance_table),
    ),
    Question(
        "hands", "Hands of other kinds", turns, {name: PLAIN[name] for name in ("E-KM", "KM+S", "KM+I")},
        hands=("all",), objects=("box", "bottle"), options=BY_HAND, columns=_ENDS,
    ),
    Question(
        "conditions", "Friction, mass, size, palm, left hand and centred grasps", turns,
        {name: PLAIN[name] for name in ("E-KM", "KM+I")}, hands=("conditions",), options=BY_HAND,
        columns=_ENDS,
    ),
    Question(
        "new_object", "Objects that are new to the hand", new_objects, BEGINNINGS,
        objects=("box", "can", "bottle", "jar"), together=True, setting=_SEEN, options={"angles": _ANGLES},
        columns=(*_ENDS[:4], "KM, first 5 [deg]", "E-KM, first 5 [deg]", "error [deg]"), split="object",
        picture=learning_picture, short={"angles": (4.0,)},
    ),
    Question(
        "engines", "The same turns in two physics engines", turns, {"E-KM": Contender()}, hands=("engines",),
        objects=tuple(TABLE_I), setting=_SEEN, options=_TO_THE_END, by="plant", columns=_ENDS, split="object",
    ),
    _WHOLE_TURN,
    replace(
        _WHOLE_TURN, name="plan", title="Parts of the plan, on hands that lose objects", contenders=PLANS,
        hands=("losing",),
    ),
    Question(
        "parts", "Parts of model and learner, on hands that lose objects", turns, PARTS,
        hands=("nominal", "losing"), objects=("box", "can", "bottle"), options=BY_HAND,
        columns=(*_ENDS[:5], "predicted by the KM [deg]", "by the E-KM [deg]"),
    ),
    Question(
        "printed", "The paper's own system", turns, PRINTED, objects=tuple(TABLE_I), options=_TO_THE_END,
        columns=_FIRST, split="object",
    ),
    Question(
        "sensing", "What each reading is worth", turns, READINGS, setting=_SEEN.replace(engine="mujoco"),
        options=BY_HAND, split="object",
        columns=(
            "turns", "lost", "reached", "error [deg]", "by the E-KM [deg]", "joints off by [deg]",
            "motors off by [deg]",
        ),
    ),
    Question(
        "oracle", "The E-KM and an oracle that knows hand, pose and forces", turns, ORACLE,
        objects=("tea_tin", "carton"), setting=Setting(), options=_TO_THE_END, columns=_ENDS, split="object",
    ),
    Question(
        "series", "Turns without a new grasp", there_and_back, PLACE,
        options={"learns_by": (9.0, -9.0, 15.0), "angle": 15.0, "times": 20}, by="case", split="object",
        columns=(*_ENDS[:4], "along the grip, last [mm]", "contacts slid, last [mm]", "other ends"),
        short={"learns_by": (), "angle": 6.0, "times": 1},
        picture=points("trial + 1", "shift", "turn, every other one back", "place along the grip [mm]"),
    ),
    Question(
        "directions", "Focused poses of one to six directions", directions, {"E-KM": Contender()},
        setting=Setting(engine="mujoco", frames=8), by="group", split="object",
        options={
            "learns_by": (9.0, 19.0, 12.0), "groups": tuple(TARGETS), "within": _WITHIN, "stricter": 0.6
        },
        columns=("turns", "declined", "within", "turn [deg]", "shift [mm]", "motions", "lost"),
        short={"learns_by": (), "groups": ("shift 3 mm",)},
    ),
    Question(
        "foresight", "How far a grasp turns, and whether that is predicted",
        foresight, ORACLE, objects=("box", "weighted_box", "can", "bottle", "applier", "tea_tin", "jar"),
        setting=Setting(), options={"learns_by": (15.0, 15.0, 15.0), "far": 70.0},
        columns=("turns", "lost", "reached", "farthest [deg]", "predicted end off by [deg]"),
        split="object", short={"learns_by": (), "far": 6.0},
        picture=points("largest", "reach - largest", "farthest turn [deg]", "predicted end less that [deg]"),
    ),
    Question(
        "slides", "Contacts that slide, open and close", slides, {"KM": Contender("KM")},
        hands=("described",), options={"motions": 25}, by="plant", columns=(), more=(errors_table,),
        objects=("box", "can", "bottle", "applier", "flashlight", "jar", "tea_tin", "carton"),
        picture=errors_picture, told=told, short={"motions": 3},
    ),
)  # fmt: skip
QUESTIONS = {asked.name: asked for asked in _ASKED}
