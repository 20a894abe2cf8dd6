"""Contacts of capsule pads with primitives: against coal, against algebra, and as functions of the state."""

import dataclasses
import functools
import math

import coal
import numpy as np
import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import torch_ekm.contact.detector
from torch_ekm.contact.detector import ContactDetector
from torch_ekm.contact.pad_contact import point_distance, signed_distance, surface_curvature, tangents
from torch_ekm.description import ContactPad, ObjectDescription, Shape, load_hand, load_object
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError
from torch_ekm.kinematics import HandKinematics
from torch_ekm.kinematics.se3 import exp
from torch_ekm.simulation.physics.links import x_axis_to

F64 = torch.float64
EYE = torch.eye(3, dtype=F64)
HAND, BOX = load_hand("planar_two_finger"), load_object("box")
RADIUS, HALF = 0.0065, 0.00718
SHAPES = {"box": (0.09, 0.03, 0.04), "cylinder": (0.02, 0.08), "sphere": (0.025,), "capsule": (0.015, 0.05)}
DEPTH = {"box": 0.015, "cylinder": 0.02, "sphere": 0.025, "capsule": 0.015}  # from side to middle


def thing(kind: str) -> ObjectDescription:
    shape = Shape(kind, SHAPES[kind], np.eye(4))  # type: ignore[arg-type]
    return dataclasses.replace(BOX, name=kind, shapes=(shape,))


def probe(obj: ObjectDescription, ball: bool = False, **options) -> ContactDetector:
    """A hand reduced to one pad on its base link, so that moving the object places it freely.

    The capsule lies along x of the hand frame with its centre at the origin.
    """
    end = 0.0 if ball else HALF
    pad = ContactPad("pad", "hand", (-end, 0.0, 0.0), (end, 0.0, 0.0), RADIUS)
    hand = dataclasses.replace(HAND, pads=(pad,))
    return ContactDetector(hand, obj, **{"margin": math.inf, **options})


@functools.cache  # many examples ask the same one
def probe_of(kind: str) -> ContactDetector:
    return probe(thing(kind))


def touch(detector: ContactDetector, position, rotation: torch.Tensor = EYE):
    return detector(torch.zeros(4, dtype=F64), torch.as_tensor(position, dtype=F64), rotation)


def turned(x: float, y: float, z: float) -> torch.Tensor:
    return exp(torch.tensor([x, y, z], dtype=F64))


# -- by hand ------------------------------------------------------------------------------------


def test_capsule_lying_on_a_face_touches_at_its_middle() -> None:
    """Curvature 1/rho across, 1/R along the axis: not a ball's."""
    contacts = touch(probe(thing("box")), [0.0, 0.015 + RADIUS, 0.0])
    torch.testing.assert_close(contacts.point[0], torch.tensor([0.0, RADIUS, 0.0], dtype=F64))
    assert float(contacts.gap) == pytest.approx(0.0, abs=1e-15)
    expected = torch.diag(torch.tensor([2.0, 0.0, 1 / RADIUS], dtype=F64))
    torch.testing.assert_close(contacts.finger_curvature[0], expected)


def test_tilted_capsule_touches_with_its_round_end() -> None:
    contacts = touch(probe(thing("box")), [0.0, 0.03, 0.0], turned(0, 0, 0.3))
    n = contacts.normal[0]
    isotropic = (EYE - torch.outer(n, n)) / RADIUS
    torch.testing.assert_close(contacts.finger_curvature[0], isotropic)
    # the end that leans on the face: the box turned by +0.3 rad comes nearer on the side of -x
    assert float(contacts.point[0, 0]) < 0


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "capsule"])
def test_a_curved_object_has_its_own_contact_point_and_no_crown(kind: str) -> None:
    """Closest points of two lines (or a line and a point) in closed form; off the pad's middle by 4 mm."""
    rng = np.random.default_rng(4)
    radius = SHAPES[kind][0]
    for _ in range(20):
        rotation = turned(*rng.uniform(-0.5, 0.5, 3))
        axis, along = rotation[:, 2], torch.tensor([1.0, 0.0, 0.0], dtype=F64)
        side = torch.linalg.cross(along, axis)
        side = side / side.norm() if kind != "sphere" else torch.tensor([0.0, -0.6, 0.8], dtype=F64)
        at = torch.tensor([0.004, 0.0, 0.0], dtype=F64)
        contacts = touch(probe_of(kind), at + (radius + RADIUS) * side, rotation)
        expected = at + RADIUS * side
        torch.testing.assert_close(contacts.point[0], expected, atol=1e-9, rtol=0)
        across = torch.linalg.cross(along, contacts.normal[0])
        expected_K = torch.outer(across, across) / RADIUS  # a cylinder's: flat along its axis
        torch.testing.assert_close(contacts.finger_curvature[0], expected_K, atol=1e-5, rtol=0)
        around = torch.linalg.cross(axis, contacts.normal[0])
        second = torch.linalg.cross(around, contacts.normal[0]) * float(kind == "sphere")
        expected_K = sum(torch.outer(e, e) / e.norm() ** 2 for e in (around, second) if e.any()) / radius
        torch.testing.assert_close(contacts.object_curvature[0], expected_K, atol=1e-5, rtol=0)


def test_a_crown_makes_up_what_the_object_lacks() -> None:
    turn = turned(0.0, math.pi / 2 - 0.1, 0.0)  # a cylinder nearly along the pad: curved by 50 sin^2(0.1) / m
    lying = touch(probe(thing("cylinder")), [0.0, 0.02 + RADIUS, 0.0], turn)
    k = math.sin(0.1) ** 2 / (0.02 + RADIUS)  # of the level set at the pad's axis
    assert float(lying.finger_curvature[0, 0, 0]) == pytest.approx(2.0 - k, abs=1e-3)


def test_edges_and_corners_are_pinned() -> None:
    edge = touch(probe(thing("box"), ball=True), [0.0, 0.015 + 0.004, 0.02 + 0.004])
    corner = touch(probe(thing("box"), ball=True), [0.045 + 0.003, 0.015 + 0.003, 0.02 + 0.003])
    rim = touch(probe(thing("cylinder"), ball=True), [0.02 + 0.003, 0.0, 0.04 + 0.003])
    cap = touch(probe(thing("cylinder"), ball=True), [0.01, 0.0, 0.04 + 0.003])
    assert (edge.pinned, corner.pinned, rim.pinned, cap.pinned) == ((True,), (True,), (True,), (False,))
    assert not cap.object_curvature.any()
    assert float(corner.gap) == pytest.approx(0.003 * math.sqrt(3) - RADIUS)


def test_compound_object_counts_its_nearest_part() -> None:
    tube = load_object("toothpaste")
    detector = probe(tube, ball=True)
    cap_side = touch(detector, [-0.05, 0.009 + RADIUS, 0.0])
    assert float(cap_side.gap) == pytest.approx(0.0, abs=1e-9)
    body = touch(detector, [0.0, 0.016 + RADIUS, 0.0])
    assert float(body.gap) == pytest.approx(0.0, abs=1e-9)
    assert body.n_c == 1


# -- against coal -------------------------------------------------------------------------------

poses = st.tuples(*[st.floats(-0.06, 0.06)] * 3, *[st.floats(-3.0, 3.0)] * 3)


def coal_distance(obj: ObjectDescription, position: torch.Tensor, rotation: torch.Tensor) -> float:
    shape = obj.shapes[0]
    kinds = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere, "capsule": coal.Capsule}
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the pad's axis is x
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = request.epa_tolerance = 1e-10
    request.gjk_max_iterations = 1000
    return coal.distance(
        coal.Capsule(RADIUS, 2 * HALF),
        coal.Transform3s(turn, np.zeros(3)),
        kinds[shape.kind](*shape.size),
        coal.Transform3s(rotation.numpy(), position.numpy()),
        request,
        result,
    )


@pytest.mark.parametrize("kind", list(SHAPES))
@settings(max_examples=100)
@given(pose=poses)
def test_gap_is_coals_distance_and_the_point_is_on_both_surfaces(kind: str, pose: tuple[float, ...]) -> None:
    """Outside, and while only the surfaces overlap; the crown adds at most half^2/(2 R) = 0.05 mm.

    Unit normal, tangent symmetric curvatures >= 0, the point on both surfaces shifted by half the gap.
    """
    obj = thing(kind)
    position, rotation = torch.tensor(pose[:3], dtype=F64), turned(*pose[3:])
    expected = coal_distance(obj, position, rotation)
    contacts = touch(probe_of(kind), position, rotation)
    n, x, gap = contacts.normal[0], contacts.point[0], float(contacts.gap)
    assert float(n.norm()) == pytest.approx(1.0, abs=1e-9)
    for K in (contacts.finger_curvature[0], contacts.object_curvature[0]):
        assert float((K @ n).abs().max()) < 1e-8
        torch.testing.assert_close(K, K.mT)
        assert float(torch.linalg.eigvalsh(K).min()) > -1e-9
    assume(expected > -0.8 * RADIUS)
    assert -1e-7 < gap - expected < HALF**2 / (2 * 0.5) + 1e-7
    on_finger = x + gap / 2 * n
    along = float(on_finger[0].clamp(-HALF, HALF))
    distance = (on_finger - torch.tensor([along, 0, 0], dtype=F64)).norm()
    # within the crown: n leans by at most half/R from the perpendicular
    assert float(distance) == pytest.approx(RADIUS, abs=1e-6)
    on_object = rotation.mT @ (x - gap / 2 * n - position)
    assert point_distance(obj.shapes[0])(*on_object.tolist())[0] == pytest.approx(0.0, abs=1e-9)
    # a flat enough crown is no crown
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(torch_ekm.contact.detector, "CROWN_RADIUS", 1e4)
        flat = touch(probe_of(kind), position, rotation)
    assert float(flat.gap) == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("kind", list(SHAPES))
def test_curvature_is_the_derivative_of_the_normal(kind: str) -> None:
    """On a smooth feature ``dn/dx = K_o`` at the surface; normals are gradients, see the signed distance."""
    shape = thing(kind).shapes[0]
    distance = point_distance(shape)
    rng = np.random.default_rng(2)
    checked = 0
    for _ in range(300):
        p = rng.uniform(-0.06, 0.06, 3)
        d, n = distance(*p)
        if d < 1e-3:
            continue  # inside there are ridges
        on = p - (d - 1e-7) * np.array(n)  # hardly outside the surface
        principal, sharp = surface_curvature(shape, tuple(on.tolist()), n)
        if sharp:
            continue
        K = sum((k * np.outer(e, e) for k, e in principal), np.zeros((3, 3)))
        for e in tangents(n):
            step = 1e-8 * np.array(e)
            dn = (np.array(distance(*(on + step))[1]) - distance(*(on - step))[1]) / 2e-8
            if np.abs(dn).max() < 1e4:  # else the step crossed an edge
                np.testing.assert_allclose(dn, K @ np.array(e), atol=1e-2 * max(1.0, np.abs(K).max()))
                checked += 1
    assert checked > 100


# -- as a function of the state -----------------------------------------------------------------


def lying(kind: str) -> torch.Tensor:
    """Its axis along the pad's."""
    return turned(0, math.pi / 2, 0) if kind in ("cylinder", "capsule") else EYE


@pytest.mark.parametrize("kind", list(SHAPES))
def test_the_contact_point_moves_continuously_as_the_finger_tilts(kind: str) -> None:
    """Through the line contact (tilt 0): no jump, and never faster than the crown lets it roll."""
    turn, detector = lying(kind), probe_of(kind)
    tilts = np.linspace(-0.05, 0.05, 101)
    points = torch.stack(
        [touch(detector, [0.0, DEPTH[kind] + RADIUS, 0.0], turned(0, 0, a) @ turn).point[0] for a in tilts]
    )
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    assert float(steps.max()) < 0.5 * (tilts[1] - tilts[0]) * 1.5
    if kind == "box":  # from one end to the other, evenly
        assert float(points[:, 0].max()) > 0.99 * HALF
        assert float(points[:, 0].min()) < -0.99 * HALF


@pytest.mark.parametrize("kind", list(SHAPES))
@settings(max_examples=100)
@given(pose=poses, along=st.tuples(*[st.floats(-1, 1)] * 6))
@example(pose=(0.047, 0.031, 0.0, 0.0, 0.0, 0.0), along=(0.0, 0.0, 0.0, 0.0, 0.0, 1.0))  # over an edge
@example(pose=(0.045, 0.0, 0.03125, 0.0, 0.0, 0.0), along=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0))  # on it
def test_no_jumps_anywhere_outside(kind: str, pose: tuple[float, ...], along: tuple[float, ...]) -> None:
    """A change of the pose by 1e-7 (m, rad) moves the contact point by at most R/(0.2 rho) that."""
    position, rotation = torch.tensor(pose[:3], dtype=F64), turned(*pose[3:])
    detector = probe_of(kind)
    before = touch(detector, position, rotation)
    assume(float(before.gap) > -0.8 * RADIUS)
    change = 1e-7 * torch.tensor(along, dtype=F64)
    after = touch(detector, position + change[:3], exp(change[3:]) @ rotation)
    assert float((after.point - before.point).norm()) < 1e-4
    assert float((after.normal - before.normal).norm()) < 1e-3
    assert float((after.gap - before.gap).abs()) < 1e-6


@pytest.mark.parametrize("kind", list(SHAPES))
def test_deep_overlap_still_says_the_way_out(kind: str) -> None:
    """The pad's axis well inside the body: the normal leads out, the gap is the depth."""
    contacts = touch(probe_of(kind), [0.0, DEPTH[kind] - 0.010, 0.0], lying(kind))
    assert contacts.n_c == 1
    assert float(contacts.normal[0, 1]) == pytest.approx(-1.0, abs=1e-6)
    assert float(contacts.gap) == pytest.approx(-0.010 - RADIUS, abs=1e-9)


def test_margin() -> None:
    box = thing("box")
    assert touch(probe(box, margin=0.002), [0.0, 0.015 + RADIUS + 0.0019, 0.0]).n_c == 1
    far = touch(probe(box, margin=0.002), [0.0, 0.015 + RADIUS + 0.0021, 0.0])
    assert far.n_c == 0
    assert far.point.shape == (0, 3)
    assert far.finger_curvature.shape == (0, 3, 3)


# -- the whole hand -----------------------------------------------------------------------------


def pinch(object_name: str, **options):
    """The object between thumb, index and middle finger, moved onto the thumb."""
    hand, obj = load_hand("icub_right"), load_object(object_name)
    kinematics = HandKinematics(hand)
    deg = {"thumb_0": 58, "thumb_1": 8, "thumb_2": 13, "thumb_3": 13}
    deg |= {"index_1": 40, "index_2": 19, "index_3": 19, "middle_1": 40, "middle_2": 19, "middle_3": 19}
    q = torch.tensor([math.radians(deg.get(name, 0.0)) for name in hand.joint_names], dtype=F64)
    link = kinematics(q)
    thumb, index, middle = (link.of(f"{finger}_tip")[:3, 3] for finger in ("thumb", "index", "middle"))
    y = (index + middle) / 2 - thumb
    y = y / y.norm()
    x = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    x = x - y * (x @ y)
    x = x / x.norm()
    rotation = torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)
    position = thumb + y * (obj.grasp_width / 2 + RADIUS)
    detector = ContactDetector(hand, obj, kinematics=kinematics, **options)
    return detector, q, position, rotation


@pytest.mark.parametrize("name", ["box", "toothpaste"])
def test_every_object_in_the_hand(name: str) -> None:
    detector, q, position, rotation = pinch(name, margin=math.inf)
    contacts = detector(q, position, rotation)
    assert contacts.finger == ("thumb", "index", "middle", "ring", "little")
    assert contacts.link == tuple(f"{finger}_3" for finger in contacts.finger)
    assert abs(float(contacts.gap[0])) < 5e-4
    # thumb and fingers press against each other
    assert float(contacts.normal[0] @ contacts.normal[1]) < -0.8
    assert torch.equal(contacts.friction, torch.full((5,), load_object(name).friction, dtype=F64))
    near = pinch(name)[0](q, position, rotation)
    assert near.n_c < 5
    assert near.finger[0] == "thumb"


def test_shared_poses_and_float32() -> None:
    detector, q, position, rotation = pinch("box")
    expected = detector(q, position, rotation)
    again = detector(detector.kinematics(q), position, rotation)
    assert torch.equal(expected.point, again.point)
    single = detector(q.float(), position.float(), rotation.float())
    assert single.point.dtype == single.friction.dtype == torch.float32
    torch.testing.assert_close(single.point.double(), expected.point, atol=1e-5, rtol=0)


def test_moving_hand_and_object_together_changes_nothing() -> None:
    """Everything is relative: turning the pad's link with the object turns point and normal alike."""
    obj = load_object("applier")
    a = touch(probe(obj), [0.012, 0.018, 0.003], turned(0.2, 0.1, -0.1))
    hand = load_hand("planar_two_finger")
    pad = ContactPad("pad", "left_0", (-HALF, 0.0, 0.0), (HALF, 0.0, 0.0), RADIUS)
    detector = ContactDetector(dataclasses.replace(hand, pads=(pad,)), obj, margin=math.inf)
    q = torch.tensor([0.4, 0.0, 0.0, 0.0], dtype=F64)
    T = detector.kinematics(q).of("left_0")
    R, t = T[:3, :3], T[:3, 3]
    moved = detector(q, R @ torch.tensor([0.012, 0.018, 0.003], dtype=F64) + t, R @ turned(0.2, 0.1, -0.1))
    torch.testing.assert_close(moved.point[0], R @ a.point[0] + t, atol=1e-9, rtol=0)
    torch.testing.assert_close(moved.normal[0], R @ a.normal[0], atol=1e-9, rtol=0)
    torch.testing.assert_close(moved.finger_curvature[0], R @ a.finger_curvature[0] @ R.mT, atol=1e-5, rtol=0)


@pytest.mark.usefixtures("unchecked")
def test_errors() -> None:
    detector, q, position, rotation = pinch("box")
    with pytest.raises(ShapeError, match="q"):
        detector(q[None], position, rotation)
    with pytest.raises(ShapeError, match="poses"):
        detector(detector.kinematics(q[None]), position, rotation)
    with pytest.raises(ShapeError, match="rotation"):
        detector(q, position, rotation[None])
    with pytest.raises(NonFiniteError, match="position"):
        detector(q, position * math.nan, rotation)
    for bad in ({"margin": -1.0}, {"margin": math.nan}):
        with pytest.raises(ParameterError):
            ContactDetector(detector.hand, detector.obj, **bad)
    assert "box" in repr(detector)


# -- signed distances ------------------------------------------------------------------------------------

SIZES = {"box": (0.09, 0.03, 0.04), "cylinder": (0.02, 0.08), "sphere": (0.025,), "capsule": (0.015, 0.06)}


def placed(kind, seed=0):
    generator = np.random.default_rng(seed)
    transform = x_axis_to(generator.standard_normal(3))
    transform[:3, 3] = generator.uniform(-0.02, 0.02, 3)
    return Shape(kind, SIZES[kind], transform)


@pytest.mark.parametrize("kind", SIZES)
def test_normal_is_the_gradient_inside_and_outside(kind):
    shape, generator, step = placed(kind), np.random.default_rng(2), 1e-7
    points = generator.uniform(-0.06, 0.06, (300, 3))
    distance, normal = signed_distance((shape,), points)
    assert (distance < 0).any()
    assert (distance > 0).any()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-12)
    ahead, back = ([signed_distance((shape,), points + h * e)[0] for e in np.eye(3)] for h in (step, -step))
    gradient = np.subtract(ahead, back).T / (2 * step)
    smooth = np.abs(np.linalg.norm(gradient, axis=-1) - 1) < 1e-5  # not across an inner edge
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(gradient[smooth], normal[smooth], atol=1e-5)


@pytest.mark.parametrize("kind", SIZES)
def test_one_point_and_many_give_the_same(kind):
    shape = Shape(kind, SIZES[kind], np.eye(4))
    points = np.random.default_rng(7).uniform(-0.06, 0.06, (300, 3))
    points[:4] = [[0, 0, 0.01], [0, 0, -0.07], [0.001, 0, 0], [0.05, -0.05, 0.05]]  # on the axis, and far off
    distance, normal = signed_distance((shape,), points)
    one = [point_distance(shape)(*point) for point in points.tolist()]
    np.testing.assert_allclose([d for d, _ in one], distance, atol=1e-16)
    np.testing.assert_allclose([n for _, n in one][2:], normal[2:], atol=1e-14)
    assert all(np.linalg.norm(n) == pytest.approx(1.0) for _, n in one)


def test_on_the_axis_of_a_cylinder_a_normal_is_given():
    long = Shape("cylinder", (0.02, 0.1), np.eye(4))
    distance, normal = signed_distance((long,), np.zeros((2, 3)))
    np.testing.assert_allclose(distance, -0.02)
    np.testing.assert_array_equal(normal, [[1, 0, 0]] * 2)
    np.testing.assert_array_equal(signed_distance((long,), np.zeros(3))[1], [1, 0, 0])


@pytest.mark.parametrize("kind", SIZES)
def test_a_grown_shape_is_nearer_by_as_much(kind):
    """Along its axes, where no edge is nearest."""
    shape, d = Shape(kind, SIZES[kind], np.eye(4)), 0.002
    points = 0.08 * np.vstack([np.eye(3), -np.eye(3)])
    apart = signed_distance((shape,), points)[0] - signed_distance((shape.grown(d),), points)[0]
    np.testing.assert_allclose(apart, d, atol=1e-12)
    assert shape.grown(-1.0).size > (0.0,) * len(shape.size)
