"""What is asked of the matrix: plants, objects, contenders, what a session does, and what answers."""

from __future__ import annotations

import dataclasses

from contenders import BEGINNINGS, ORACLE, PARTS, PLAIN, PLANS, PRINTED, WHOLE_TURNS, Contender
from matrix import Frame, Question, bands_table, learning_picture, table
from sessions import TARGETS, directions, foresight, new_objects, there_and_back, turns

from torch_ekm.experiments.reporting.report import Table

_ANGLES = (9.0, 19.0, 27.0)  # [deg] from fresh grasps
_WARM_UP = {"learns_by": 3}  # turns of the E-KM before those that count
BY_HAND = {"angles": _ANGLES, **_WARM_UP}
SHORT = {"angles": (4.0,), "learns_by": ()}
_ENDS = ("turns", "lost", "reached", "motions", "error [deg]", "other ends")
_MOVEMENTS = ("turns", "lost", "reached", "turning movements", "motions", "seconds", "error [deg]")
#: The camera has 20 Hz and is 0.05 s late.
_CAMERA = {"frame_rate": 20.0, "latency": 0.05}
#: True errors that are called near a focused pose.
WITHIN = {"deg": 0.25, "mm": 0.2}


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
    "Whole turns: with a plan and without, f and g",
    turns,
    WHOLE_TURNS,
    hands="nominal,fingertips x 2,friction 0.4,odd 4",
    objects="box,can,bottle",
    options={"angles": _ANGLES, "learns_by": (14.0, -8.0, 22.0), "all_learn": True},
    plant=_CAMERA,
    columns=_MOVEMENTS,
    more=(_first, _ends, bands_table),
    quick={"angles": (5.0,), "learns_by": (4.0,)},
)
QUESTIONS: dict[str, Question] = {
    "whole_turn": _WHOLE_TURN,
    "plan": dataclasses.replace(
        _WHOLE_TURN, title="Parts of the plan, on hands that lose objects", contenders=PLANS, hands="losing"
    ),
    "series": Question(
        "Turns without a new grasp",
        there_and_back,
        {"E-KM": Contender()},
        options={"learns_by": (9.0, -9.0, 15.0), "angle": 15.0, "times": 20},
        by="part",
        columns=(*_ENDS[:4], "along the grip, last [mm]", "contacts slid, last [mm]", "other ends"),
        split="object",
        quick={"learns_by": (), "angle": 6.0, "times": 1},
    ),
    "directions": Question(
        "Focused poses of one to six directions",
        directions,
        {"E-KM": Contender()},
        options={
            "learns_by": (9.0, 19.0, 12.0),
            "groups": tuple(TARGETS),
            "within": WITHIN,
            "stricter": 0.6,
        },
        setting={"frames": 8},
        by="group",
        columns=("turns", "declined", "within", "turn [deg]", "shift [mm]", "motions", "lost"),
        split="object",
        quick={"learns_by": (), "groups": ("shift 3 mm",)},
    ),
    "foresight": Question(
        "How far a grasp turns, whether that is predicted, and turns without the camera",
        foresight,
        ORACLE,
        objects="box,weighted_box,can,bottle,applier,tea_tin,jar",
        engine="sapien",
        options={"learns_by": (15.0, 15.0, 15.0), "far": 70.0, "blind": 15.0},
        by="case",
        columns=(
            "turns", "lost", "reached", "farthest [deg]", "predicted end off by [deg]",
            "estimate off by [deg]", "stated sd [deg]",
        ),
        split="object",
        quick={"learns_by": (), "far": 6.0, "blind": 5.0},
    ),
    "hands": Question(
        "Hands of other kinds", turns, {n: PLAIN[n] for n in ("E-KM", "KM+S", "KM+I")}, hands="all",
        objects="box,bottle", options=BY_HAND, columns=_ENDS, quick=SHORT,
    ),
    "conditions": Question(
        "Friction, mass, size, palm, left hand and centred grasps", turns,
        {n: PLAIN[n] for n in ("E-KM", "KM+I")}, hands="conditions", options=BY_HAND, columns=_ENDS,
        quick=SHORT,
    ),
    "engines": Question(
        "The same turns in two physics engines", turns, {"E-KM": Contender()}, hands="engines",
        objects="box,weighted_box,can,bottle,applier", options={**_WARM_UP, "angles": None}, by="plant",
        setting={"sensing": True}, columns=_ENDS, split="object", quick=SHORT,
    ),
    "new_object": Question(
        "Objects that are new to the hand", new_objects, BEGINNINGS, objects="box,can,bottle,jar",
        engine="sapien", options={"angles": _ANGLES}, together=True, setting={"sensing": True},
        columns=(*_ENDS[:4], "KM, first 5 [deg]", "E-KM, first 5 [deg]", "error [deg]"),
        split="object", picture=learning_picture, quick={"angles": (4.0,)},
    ),
    "printed": Question(
        "The paper's own system", turns, PRINTED, objects="box,weighted_box,can,bottle,applier",
        options={**_WARM_UP, "angles": None}, split="object",
        columns=("turns", "lost", "reached", "motions", "first motion [deg]", "error [deg]", "other ends"),
        quick=SHORT,
    ),
    "parts": Question(
        "Parts of model and learner, on hands that lose objects", turns, PARTS, hands="nominal,losing",
        objects="box,can,bottle", options=BY_HAND, quick=SHORT,
        columns=(*_ENDS[:5], "predicted by the KM [deg]", "by the E-KM [deg]"),
    ),
    "oracle": Question(
        "The E-KM and an oracle that knows hand, pose and forces", turns, ORACLE, objects="tea_tin,carton",
        engine="sapien", options={**_WARM_UP, "angles": None}, columns=_ENDS, split="object", quick=SHORT,
    ),
}  # fmt: skip
