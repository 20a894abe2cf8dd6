"""The hand of a robot: the part of the tree that its base carries."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from ..exceptions import DescriptionError
from .mimic import Mimic
from .urdf import MOVING, UrdfJoint, UrdfModel


def hand_below(urdf: UrdfModel, base: str, named: Iterable[str] = (), path: Path | None = None) -> UrdfModel:
    """The part of ``urdf`` that ``base`` carries, as a tree of its own, with a note on what is left out.

    A base that carries no joint is a frame: of all that is carried by what it is fixed to. One that is fixed
    to the root keeps the whole tree if a joint ``named`` is elsewhere. A joint that is a ``<mimic>`` of one
    that is left out is locked.

    Raises:
        DescriptionError: there is no link of that name; it names ``path``, or the URDF.
    """
    names = [link.name for link in urdf.links]
    if base not in names:
        problem = f"unknown base_link '{base}'; links are: {', '.join(names)}"
        raise DescriptionError(path or urdf.path, problem)
    top, joints, to_base = base, _beyond(urdf, base), urdf.joints_to(base)
    while to_base and to_base[-1].kind == "fixed" and not any(joint.kind in MOVING for joint in joints):
        top = to_base.pop().parent
        joints = _beyond(urdf, top)
    kept = {joint.name for joint in joints}
    left_out = {joint.name for joint in urdf.moving_joints} - kept
    fixed = all(joint.kind == "fixed" for joint in to_base)
    if not left_out or (fixed and left_out & set(named)):
        return urdf
    notes = [f"the hand is what '{top}' carries; {len(left_out)} joints elsewhere are left out"]
    mimics = []
    for mimic in urdf.mimics:
        if mimic.joint in kept and mimic.other in left_out:
            notes.append(f"'{mimic.joint}' is a <mimic> of '{mimic.other}', which is left out: it is locked")
            mimic = Mimic(mimic.joint, mimic.other, 0.0, mimic.offset)
        mimics += [mimic] if mimic.joint in kept else []
    below = {top, *(joint.child for joint in joints)}
    links = tuple(link for link in urdf.links if link.name in below)
    notes = (*notes, *urdf.notes)
    return replace(urdf, links=links, joints=joints, root=top, mimics=tuple(mimics), notes=notes)


def _beyond(urdf: UrdfModel, link: str) -> tuple[UrdfJoint, ...]:
    """The joints that a link carries, in document order."""
    below = [link]
    for one in below:
        below += [joint.child for joint in urdf.joints if joint.parent == one]
    return tuple(joint for joint in urdf.joints if joint.parent in below)
