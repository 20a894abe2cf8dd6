"""The hand of a robot: the part of the tree that its base carries."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from ..exceptions import DescriptionError
from .mimic import Mimic
from .urdf import UrdfModel


def hand_below(urdf: UrdfModel, base: str, named: Iterable[str] = (), path: Path | None = None) -> UrdfModel:
    """The part of ``urdf`` that ``base`` carries, with ``base`` as its root and a note on what is left out.

    A base that is fixed to the root is the frame of the whole tree if nothing moves below it, or if one of
    the joints ``named`` is elsewhere. A joint that is a ``<mimic>`` of one that is left out is locked.

    Raises:
        DescriptionError: there is no link of that name; it names ``path``, or the URDF.
    """
    names = [link.name for link in urdf.links]
    if base not in names:
        problem = f"unknown base_link '{base}'; links are: {', '.join(names)}"
        raise DescriptionError(path or urdf.path, problem)
    below, carried = [base], list(urdf.joints)
    for link in below:
        below += [joint.child for joint in carried if joint.parent == link]
    joints = tuple(joint for joint in urdf.joints if joint.parent in below)
    kept = {joint.name for joint in joints}
    left_out = [joint.name for joint in urdf.moving_joints if joint.name not in kept]
    fixed = all(joint.kind == "fixed" for joint in urdf.joints_to(base))
    moves = len(left_out) < len(urdf.moving_joints)
    if not left_out or (fixed and (not moves or set(left_out) & set(named))):
        return urdf
    notes = [f"the hand is what '{base}' carries; {len(left_out)} joints elsewhere are left out"]
    mimics = []
    for mimic in urdf.mimics:
        if mimic.joint in kept and mimic.other in left_out:
            notes.append(f"'{mimic.joint}' is a <mimic> of '{mimic.other}', which is left out: it is locked")
            mimic = Mimic(mimic.joint, mimic.other, 0.0, mimic.offset)
        mimics += [mimic] if mimic.joint in kept else []
    links = tuple(link for link in urdf.links if link.name in below)
    notes = (*notes, *urdf.notes)
    return replace(urdf, links=links, joints=joints, root=base, mimics=tuple(mimics), notes=notes)
