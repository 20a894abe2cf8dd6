"""Forward kinematics and Jacobians: references, shapes, dtypes, derivatives, errors; iKin's fingers.

iKin, the robot's own library, is written down here a second time and from the other end: its
denavit-hartenberg figures as they stand in robotology/icub-main (commit 24c1a0030,
src/libraries/iKin/src/iKinFwd.cpp, iCubFinger::allocate, right hand, thumb version b; BSD-3-Clause) and in
icub-tech-iit/documentation (icub-forward-kinematics-fingers.md). iKin counts the abduction angle from the
spread pose, has a dummy second link in the thumb and no abduction in the middle finger.
"""

import copy
import math
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from own_files import change, copied

from torch_ekm.description import HandDescription, load_hand
from torch_ekm.exceptions import ParameterError, ShapeError, UnknownNameError
from torch_ekm.kinematics import HandKinematics
from torch_ekm.kinematics.se3 import hat

HANDS = ("icub_right", "icub_left", "planar_two_finger")
SHAPES = ((), (1,), (5,), (2, 3), (0,))


def postures(name: str, *shape: int, seed: int = 3) -> torch.Tensor:
    hand = load_hand(name)
    lower, upper = torch.from_numpy(hand.joint_lower), torch.from_numpy(hand.joint_upper)
    uniform = torch.rand(*shape, hand.n_q, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return lower + uniform * (upper - lower)


def reference_transforms(hand: HandDescription, q: torch.Tensor) -> torch.Tensor:
    """``T_j = T_parent(j) O_j (I + sin q_j [z_j]x + (1 - cos q_j) [z_j]x^2)``, link by link, in float64."""
    poses = {hand.urdf.root: torch.eye(4, dtype=torch.float64).expand(*q.shape[:-1], 4, 4)}
    joints = list(hand.urdf.joints)
    while joints:
        joint = next(joint for joint in joints if joint.parent in poses)
        joints.remove(joint)
        turn = torch.eye(4, dtype=torch.float64).repeat(*q.shape[:-1], 1, 1)
        if joint.name in hand.joint_names:
            angle = q[..., hand.joint_names.index(joint.name), None, None]
            K = hat(torch.from_numpy(joint.axis))
            turn[..., :3, :3] += torch.sin(angle) * K + 2 * torch.sin(angle / 2) ** 2 * (K @ K)
        poses[joint.child] = poses[joint.parent] @ torch.from_numpy(joint.transform) @ turn
    T = torch.stack([poses[name] for name in hand.link_names], dim=-3)
    return torch.linalg.inv(poses[hand.base_link])[..., None, :, :] @ T


@pytest.mark.parametrize("name", HANDS)
def test_poses_to_the_last_digits(name: str) -> None:
    """In float64: the library's own reader would leave 1e-7 of its float32 origins."""
    hand, q = load_hand(name), 5 * postures(name, 2, 100)  # turns of more than pi, too
    kinematics, expected = HandKinematics(hand), reference_transforms(hand, q)
    for given in (q, q.clone().requires_grad_()):  # for derivatives the chain goes another way
        torch.testing.assert_close(kinematics(given).transforms.detach(), expected, atol=1e-12, rtol=0)
    for k in range(5):
        torch.testing.assert_close(kinematics(q[0, k]).transforms, expected[0, k], atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", HANDS)
def test_jacobians_against_autograd(name: str) -> None:
    """Rows (v; w): ``v = dx/dq``, ``[w]x = dR/dq R^T``, to 1e-10, every link."""
    kinematics, q = HandKinematics(load_hand(name)), postures(name, 2)
    point = torch.tensor([0.011, -0.004, 0.006], dtype=torch.float64)
    for row in q:
        T = kinematics(row).transforms
        dT = torch.func.jacrev(lambda x: kinematics(x).transforms)(row)  # (n_link, 4, 4, n_q)
        for k, link in enumerate(kinematics.link_names):
            J = kinematics.jacobian(row, link, point)
            v = torch.einsum("abj,b->aj", dT[k, :3, :3], point) + dT[k, :3, 3]
            W = torch.einsum("abj,cb->jac", dT[k, :3, :3], T[k, :3, :3])
            w = torch.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]])
            torch.testing.assert_close(J, torch.cat([v, w]), atol=1e-10, rtol=0)


@pytest.mark.parametrize("shape", SHAPES)
def test_batch_shapes(shape: tuple[int, ...]) -> None:
    kinematics, q = HandKinematics(load_hand("icub_right")), postures("icub_right", *shape)
    poses = kinematics(q)
    assert poses.transforms.shape == (*shape, 26, 4, 4)
    assert poses.of("thumb_3").shape == (*shape, 4, 4)
    assert kinematics.jacobian(q, "thumb_tip").shape == (*shape, 6, 20)
    axis, origin = kinematics.joint_axes(poses)
    assert axis.shape == origin.shape == (*shape, 20, 3)
    flat_q, flat_T = q.reshape(-1, 20), poses.transforms.reshape(-1, 26, 4, 4)
    points = torch.rand(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    J = kinematics.jacobian(q, "index_2", points).reshape(-1, 6, 20)
    for k, row in enumerate(flat_q):
        torch.testing.assert_close(flat_T[k], kinematics(row).transforms, atol=1e-14, rtol=0)
        one = kinematics.jacobian(row, "index_2", points.reshape(-1, 3)[k])
        torch.testing.assert_close(J[k], one, atol=1e-14, rtol=0)


def test_float32_and_to() -> None:
    hand, q = load_hand("icub_right"), postures("icub_right", 4)
    double = HandKinematics(hand)
    single = HandKinematics(hand, dtype=torch.float32)
    moved = copy.deepcopy(double).to(torch.float32)
    for module in (single, moved):
        T = module(q.float()).transforms
        assert T.dtype == torch.float32
        torch.testing.assert_close(T.double(), double(q).transforms, atol=1e-6, rtol=0)
    assert not list(double.parameters())
    with pytest.raises(ParameterError, match="float32"):
        double(q.float())


def test_copies_are_copies() -> None:
    """The chain is no Module and changes in place: a copy's dtype must not reach the original."""
    q = postures("icub_right", 4)
    kinematics = HandKinematics(load_hand("icub_right"))
    before = kinematics(q).transforms
    for other in (copy.deepcopy(kinematics), pickle.loads(pickle.dumps(kinematics))):
        torch.testing.assert_close(other(q).transforms, before, atol=0, rtol=0)
        torch.nn.Sequential(other).float()  # as a part of a larger module
        assert other.dtype == torch.float32
        assert other(q.float()).transforms.dtype == torch.float32
        torch.testing.assert_close(kinematics(q).transforms, before, atol=0, rtol=0)
    assert not kinematics.state_dict()  # all of it is in the description
    kinematics.load_state_dict({})


def test_function_transforms() -> None:
    """jacrev, jacfwd and hessian go through the forward kinematics; batch dimensions stand for vmap."""
    kinematics, q = HandKinematics(load_hand("icub_right")), postures("icub_right", 3)

    def tip(x: torch.Tensor) -> torch.Tensor:
        return kinematics(x).of("index_tip")[..., :3, 3]

    J = kinematics.jacobian(q, "index_tip")[:, :3]
    for transform in (torch.func.jacfwd, torch.func.jacrev):
        torch.testing.assert_close(transform(tip)(q[0]), J[0], atol=1e-10, rtol=0)
        batched = transform(lambda x: tip(x).sum(0))(q).movedim(1, 0)  # a row depends on its own angles only
        torch.testing.assert_close(batched, J, atol=1e-10, rtol=0)
    H = torch.func.hessian(tip)(q[0])
    expected = torch.func.jacrev(lambda x: kinematics.jacobian(x, "index_tip")[:3])(q[0])
    torch.testing.assert_close(H, expected, atol=1e-10, rtol=0)
    with pytest.raises(RuntimeError, match="vmap"):
        torch.func.vmap(tip)(q)


def test_base_link_behind_a_fixed_joint(tmp_path) -> None:
    """The hand frame may be any link that does not move."""
    hand, (urdf, _) = load_hand("planar_two_finger"), copied(tmp_path)
    mount = '<link name="wrist"/><joint name="mount" type="fixed"><parent link="wrist"/><child link="hand"/>'
    mount += '<origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></joint></robot>'
    change(urdf, "</robot>", mount)
    mounted = load_hand(urdf)
    q = postures("planar_two_finger", 2)
    expected = HandKinematics(hand)(q)
    actual = HandKinematics(mounted)(q)
    assert mounted.urdf.root == "wrist"
    for link in hand.link_names:
        torch.testing.assert_close(actual.of(link), expected.of(link), atol=1e-13, rtol=0)
    torch.testing.assert_close(actual.transforms, reference_transforms(mounted, q), atol=1e-12, rtol=0)


def test_joints_in_another_order_than_the_tree(tmp_path: Path) -> None:
    """``q`` is in document order, whatever order the chain walks its tree in."""
    hand, (urdf, _) = load_hand("planar_two_finger"), copied(tmp_path)
    text = urdf.read_text()
    joints = re.findall(
        r'  <joint name="left_0".*?</joint>|  <joint name="right_1".*?</joint>', text, re.DOTALL
    )
    swapped = text.replace(joints[0], "@").replace(joints[1], joints[0]).replace("@", joints[1])
    urdf.write_text(swapped)
    other = load_hand(urdf)
    assert other.joint_names == ("right_1", "left_1", "right_0", "left_0")
    q = postures("planar_two_finger", 2)
    order = [hand.joint_names.index(name) for name in other.joint_names]
    mine, theirs = HandKinematics(hand), HandKinematics(other)
    for link in hand.link_names:
        torch.testing.assert_close(theirs(q[:, order]).of(link), mine(q).of(link), atol=1e-14, rtol=0)
        J = mine.jacobian(q, link)[..., order]
        torch.testing.assert_close(theirs.jacobian(q[:, order], link), J, atol=1e-14, rtol=0)


@pytest.mark.usefixtures("unchecked")
def test_errors_list_what_would_be_right() -> None:
    kinematics = HandKinematics(load_hand("planar_two_finger"))
    for bad in (torch.zeros(3), torch.zeros(2, 5), torch.tensor(0.0)):
        with pytest.raises(ShapeError, match="left_0, left_1, right_0, right_1"):
            kinematics(bad.double())
    q = torch.zeros(4, dtype=torch.float64)
    with pytest.raises(UnknownNameError, match="left_tip"):
        kinematics.jacobian(q, "tip")
    with pytest.raises(UnknownNameError, match="right_tip"):
        kinematics(q).of("tip")
    with pytest.raises(ShapeError, match="point"):
        kinematics.jacobian(q, "left_tip", torch.zeros(2, dtype=torch.float64))
    assert "planar_two_finger" in repr(kinematics)


POSTURES = 1000

H0 = {
    "thumb": [
        [0.478469, 0.063689, -0.875792, -0.024029759],
        [-0.878095, 0.039246, -0.476873, -0.01193433],
        [0.004, 0.997198, 0.074703, -0.00168926],
    ],
    "index": [
        [0.898138, 0.439714, 0.0, 0.00245549],
        [-0.43804, 0.89472, 0.087156, -0.025320433],
        [0.038324, -0.078278, 0.996195, -0.010973325],
    ],
    "middle": [[1.0, 0.0, 0.0, 0.0178], [0.0, 0.0, -1.0, -0.00830233], [0.0, 1.0, 0.0, -0.0118]],
    "ring": [
        [0.9998, 0.0192, 0.0, 0.00156923],
        [0.0191, -0.996, 0.0872, 0.007158757],
        [0.0017, -0.0871, -0.9962, -0.011458935],
    ],
    "little": [
        [0.9998, 0.0192, 0.0, -0.00042147],
        [0.0191, -0.996, 0.0872, 0.0232755],
        [0.0017, -0.0871, -0.9962, -0.00956329],
    ],
}
# a [m], d [m], alpha [deg], offset [deg] of each link
LINKS = {
    "thumb": [(0, 0, -90, 0), (0.021, 0.0056, 0, 0), (0.026, 0, 0, 0), (0.022, 0, 0, 0), (0.0168, 0, -90, 0)],
    "index": [(0.0148, 0, 90, 0), (0.0259, 0, 0, 0), (0.022, 0, 0, 0), (0.0168, 0, -90, 0)],
    "middle": [(0.0285, 0, 0, 0), (0.024, 0, 0, 0), (0.0168, 0, -90, 0)],
    "ring": [(0.0148, 0, -90, -20), (0.0259, 0, 0, 0), (0.022, 0, 0, 0), (0.0168, 0, -90, 0)],
    "little": [(0.0148, 0, -90, -20), (0.0219, 0, 0, 0), (0.019, 0, 0, 0), (0.0168, 0, -90, 0)],
}
SPREAD = math.radians(20)


def ikin_angles(finger: str, q: np.ndarray) -> np.ndarray:
    """Our four joint angles of a finger -> the angles of iKin's links."""
    if finger == "thumb":
        return np.array([q[0], 0.0, q[1], q[2], q[3]])
    if finger == "middle":
        return q[1:]
    return np.array([SPREAD - q[0], *q[1:]])


def ikin_tip(finger: str, angles: np.ndarray) -> np.ndarray:
    """``T = H0 prod Rz(theta + offset) Tz(d) Tx(a) Rx(alpha)``"""
    T = np.vstack([H0[finger], [0, 0, 0, 1]])
    for (a, d, alpha_deg, offset_deg), angle in zip(LINKS[finger], angles, strict=True):
        c, s = math.cos(angle + math.radians(offset_deg)), math.sin(angle + math.radians(offset_deg))
        ca, sa = math.cos(math.radians(alpha_deg)), math.sin(math.radians(alpha_deg))
        T = T @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return T


@pytest.mark.parametrize("finger", list(LINKS))
def test_fingertips_are_where_ikin_says(finger: str) -> None:
    hand = load_hand("icub_right")
    rng = np.random.default_rng(11)
    q = hand.joint_lower + rng.random((POSTURES, hand.n_q)) * (hand.joint_upper - hand.joint_lower)
    ours = HandKinematics(hand)(torch.from_numpy(q)).of(f"{finger}_tip").numpy()
    first = hand.joint_names.index(f"{finger}_0")
    theirs = np.stack([ikin_tip(finger, ikin_angles(finger, row[first : first + 4])) for row in q])
    assert np.abs(ours[:, :3, 3] - theirs[:, :3, 3]).max() < 1e-5
    # iKin prints H0 with 4 to 6 digits, so its rotations are orthonormal to 1e-4 only
    assert np.abs(ours[:, :3, :3] - theirs[:, :3, :3]).max() < 2e-4


def test_the_left_hand_is_the_mirror_image() -> None:
    """``p_left = M p_right``, ``R_left = M R_right D`` M the reflection of y, D that of one link axis."""
    right, left = load_hand("icub_right"), load_hand("icub_left")
    assert right.joint_names == left.joint_names
    rng = np.random.default_rng(12)
    q = right.joint_lower + rng.random((50, 20)) * (right.joint_upper - right.joint_lower)
    T_right, T_left = (HandKinematics(hand)(torch.from_numpy(q)).transforms for hand in (right, left))
    M = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(T_left[..., :3, 3], T_right[..., :3, 3] @ M, atol=1e-9, rtol=0)
    D = T_right[..., :3, :3].mT @ M @ T_left[..., :3, :3]
    kinds = torch.stack(
        [torch.diag(torch.tensor(d, dtype=torch.float64)) for d in ((1.0, -1, 1), (1.0, 1, -1))]
    )
    assert bool(((D[..., None, :, :] - kinds).abs().amax((-1, -2)) < 1e-9).any(-1).all())
