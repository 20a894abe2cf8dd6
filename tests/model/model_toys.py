"""Small hands for the tests: joints in chains, ball fingertips, kinematics of their own."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from torch_ekm.contact.contact_set import ContactSet
from torch_ekm.description import Actuator, HandDescription
from torch_ekm.description.urdf import UrdfModel
from torch_ekm.kinematics import LinkPoses, se3

F64 = torch.float64


class ChainKinematics(nn.Module):
    """Fingers of revolute joints: (origin relative to the predecessor, axis) of each."""

    dtype = F64

    def __init__(self, fingers: list[list[tuple[np.ndarray, np.ndarray]]]):
        super().__init__()
        self.fingers = [
            [(torch.tensor(T, dtype=F64), torch.tensor(z, dtype=F64)) for T, z in finger]
            for finger in fingers
        ]
        self.lengths = [len(finger) for finger in fingers]
        self.origins, self.axes = (
            torch.stack([joint[k] for finger in self.fingers for joint in finger]) for k in range(2)
        )
        self.link_names = tuple(f"f{i}_l{j}" for i, finger in enumerate(fingers) for j in range(len(finger)))
        n_q = len(self.link_names)
        upstream = torch.zeros(n_q, n_q, dtype=torch.bool)
        at = 0
        for finger in fingers:
            for j in range(len(finger)):
                upstream[at + j, at : at + j + 1] = True
            at += len(finger)
        self.register_buffer("upstream", upstream)

    def forward(self, q):
        turns = torch.zeros(*q.shape, 4, 4, dtype=F64)
        turns[..., 3, 3] = 1
        turns[..., :3, :3] = se3.exp(q[..., None] * self.axes)
        rows = []
        for joints in (self.origins @ turns).split(self.lengths, dim=-3):
            T = torch.eye(4, dtype=F64)
            for joint in joints.unbind(-3):
                T = T @ joint
                rows.append(T)
        return LinkPoses(torch.stack(rows, dim=-3), self.link_names)

    def joint_axes(self, poses):
        T = poses.transforms
        return (T[..., :3, :3] @ self.axes[..., None])[..., 0], T[..., :3, 3]


@dataclass(frozen=True)
class ToyObject:
    mass: float
    com: np.ndarray
    friction: float = 0.8


def toy_hand(
    n_q,
    J_a,
    springs,
    rest,
    *,
    tendon=True,
    stiffness=np.inf,
    coupling=None,
    planar=None,
    lower=-3.0,
    upper=3.0,
):
    J_a = np.atleast_2d(np.asarray(J_a, dtype=float))
    return HandDescription(
        name="toy",
        urdf=UrdfModel(Path("toy.urdf"), "toy", (), (), "palm"),
        transmission_path=Path("toy.toml"),
        base_link="palm",
        link_names=tuple(f"l{j}" for j in range(n_q)),
        joint_names=tuple(f"j{j}" for j in range(n_q)),
        joint_lower=np.broadcast_to(np.asarray(lower, dtype=float), (n_q,)).copy(),
        joint_upper=np.broadcast_to(np.asarray(upper, dtype=float), (n_q,)).copy(),
        actuators=tuple(
            Actuator(f"a{k}", -10.0, 10.0, tendon=tendon, stiffness=stiffness) for k in range(len(J_a))
        ),
        actuation_jacobian=J_a,
        coupling=np.zeros((0, n_q)) if coupling is None else np.asarray(coupling, dtype=float),
        spring_stiffness=np.asarray(springs, dtype=float),
        spring_rest=np.asarray(rest, dtype=float),
        joint_friction=np.zeros(n_q),
        pads=(),
        planar_normal=planar,
    )


def transform(xyz, rpy=(0.0, 0.0, 0.0)):
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return placed


def isotropic(normal: torch.Tensor, curvature: float) -> torch.Tensor:
    return curvature * (torch.eye(3, dtype=F64) - normal[..., :, None] * normal[..., None, :])


def contact_set(links, points, normals, k_f, k_o, *, friction=3.0, gamma=0.0, pinned=False) -> ContactSet:
    n_c = len(links)
    points, normals = (torch.as_tensor(np.asarray(v), dtype=F64) for v in (points, normals))
    return ContactSet(
        finger=tuple(links),
        link=tuple(links),
        point=points,
        normal=normals,
        gap=torch.zeros(n_c, dtype=F64),
        finger_curvature=isotropic(normals, k_f),
        object_curvature=isotropic(normals, k_o),
        friction=torch.full((n_c,), friction, dtype=F64),
        torsional_friction=torch.full((n_c,), gamma, dtype=F64),
        pinned=(pinned,) * n_c,
    )


def select(contacts: ContactSet, index: list[int]) -> ContactSet:
    """The contacts with the given indices, in that order."""
    names = (
        "point",
        "normal",
        "gap",
        "finger_curvature",
        "object_curvature",
        "friction",
        "torsional_friction",
    )
    tuples = ("finger", "link", "pinned")
    return contacts.replace(
        **{name: getattr(contacts, name)[index] for name in names},
        **{name: tuple(getattr(contacts, name)[i] for i in index) for name in tuples},
    )


@dataclass
class Toy:
    """A toy grasp in exact equilibrium: the spring rest angles are chosen so that it is at rest."""

    model: object
    state: object
    contacts: ContactSet
    mu: torch.Tensor
    lam: torch.Tensor
    a: torch.Tensor

    @property
    def unit(self):
        """What 1 is of each motor in the toy's own unit, metres of its tendon."""
        return torch.tensor([actuator.unit for actuator in self.model.hand.actuators], dtype=F64)

    def solver(self, **options):
        from equilibrium import EquilibriumSolver

        return EquilibriumSolver(self.model, self.state, self.contacts, **options)

    def forces(self):
        from equilibrium import known_forces

        return known_forces(self.model.contact_kinematics(self.state, self.contacts), self.mu, self.lam)

    def equilibrium(self):
        from equilibrium import Equilibrium

        return Equilibrium(
            self.state, self.a, self.mu, self.lam, torch.zeros(0, dtype=F64), self.contacts, 0.0
        )


def build(
    fingers,
    q,
    J_a,
    springs,
    *,
    tip,
    rho,
    normals,
    contact_links,
    grip=1.5,
    mass=0.05,
    com=(0.003, -0.002, 0.004),
    lam=-0.15,
    k_o=0.0,
    friction=3.0,
    gamma=0.0,
    pinned=False,
    stiffness=np.inf,
    coupling=None,
    planar=None,
    options=None,
    tendon=True,
) -> Toy:
    """Fingers at q whose ball tips touch an object with the given normals; at rest with the given grip.

    ``lam`` is in the unit of ``J_a``, as ``stiffness`` is.
    """
    from torch_ekm.contact.contact_kinematics import constraint_matrix
    from torch_ekm.kinematics import GraspState
    from torch_ekm.model import KinematicModel
    from torch_ekm.model.stiffness.potential import gravity_gradient

    kin = ChainKinematics(fingers)
    q = torch.as_tensor(q, dtype=F64)
    n_q = len(q)
    poses = kin(q).transforms
    tips = torch.stack(
        [
            (poses[kin.link_names.index(name)] @ torch.tensor([*tip, 1.0], dtype=F64))[:3]
            for name in contact_links
        ]
    )
    normals = torch.as_tensor(np.asarray(normals), dtype=F64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    points = tips - rho * normals
    contacts = contact_set(
        contact_links,
        points,
        normals,
        1 / rho if rho else 0.0,
        k_o,
        friction=friction,
        gamma=gamma,
        pinned=pinned,
    )
    state = GraspState(q, points.mean(0), torch.eye(3, dtype=F64))
    gravity = (0.0, -9.81, 0.0) if planar else (0.0, 0.0, -9.81)
    obj = ToyObject(mass, np.asarray(com, dtype=float), friction)

    def make(rest):
        hand = toy_hand(
            n_q, J_a, springs, rest, stiffness=stiffness, coupling=coupling, planar=planar, tendon=tendon
        )
        hand = dataclasses.replace(hand, gravity=gravity)
        return KinematicModel(hand, obj, options, kinematics=kin, detector=lambda *_: contacts)

    model = make(np.zeros(n_q))
    ck = model.contact_kinematics(state, contacts)
    A = constraint_matrix(ck)
    V_p = gravity_gradient(model.weight, model.com)
    G = -A[:, n_q:].T
    wish = torch.zeros(A.shape[0], dtype=F64)
    wish[ck.normal_rows] = grip
    Zp = model.reduction.pose_basis
    mu = wish + torch.linalg.pinv(Zp.T @ G) @ (Zp.T @ (V_p - G @ wish))
    assert float((Zp.T @ (G @ mu - V_p)).abs().max()) < 1e-10
    unit = torch.tensor([actuator.unit for actuator in model.hand.actuators], dtype=F64)
    lam = torch.as_tensor(lam, dtype=F64) * unit
    torque = A[:, :n_q].T @ mu + model.reduction.actuation.T @ lam
    rest = q + torque / torch.as_tensor(np.asarray(springs, dtype=float))
    model = make(rest.numpy())
    a = model.reduction.actuation @ q - lam / model.reduction.stiffness
    return Toy(model, state, contacts, mu, lam, a)


def radial_finger(angle, radius=0.05):
    """Abduction about the radial axis, then two flexion joints; links point up (+z)."""
    base = transform((radius * np.cos(angle), radius * np.sin(angle), 0.0), (0.0, 0.0, angle))
    x, y = np.array([1.0, 0, 0]), np.array([0.0, -1.0, 0])
    return [(base, x), (np.eye(4), y), (transform((0, 0, 0.04)), y)]


def three_finger(pinned=False, grip=1.0, **kw):
    """Three fingers of three joints, three tendons (moment arms 9 and 8 mm), 50 g."""
    angles = np.array([0.0, 2.1, 4.2])
    fingers = [radial_finger(t) for t in angles]
    q = np.array([0.05, 0.35, 0.3, -0.08, 0.3, 0.4, 0.03, 0.4, 0.25])
    J_a = np.zeros((3, 9))
    for i in range(3):
        J_a[i, 3 * i + 1], J_a[i, 3 * i + 2] = 0.009, 0.008
    tilt = np.array([0.1, -0.05, 0.08])
    normals = np.stack([np.cos(angles + 0.1), np.sin(angles + 0.1), tilt], axis=-1)
    return build(
        fingers,
        q,
        J_a,
        np.tile([0.25, 0.2, 0.15], 3),
        tip=(0.0, 0.0, 0.03),
        rho=kw.pop("rho", 0.008),
        normals=normals,
        contact_links=["f0_l2", "f1_l2", "f2_l2"],
        grip=grip,
        lam=kw.pop("lam", -20.0),
        pinned=pinned,
        **kw,
    )


def soft_two_finger(grip=1.5, **kw):
    """Two fingers of four joints with soft ball tips, two tendons, object balls or planes."""
    fingers = []
    for angle in (0.0, np.pi):
        base = transform((0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.0), (0.0, 0.0, angle))
        fingers.append(
            [
                (base, np.array([0.0, 0, 1])),
                (transform((0, 0, 0.005)), np.array([1.0, 0, 0])),
                (np.eye(4), np.array([0.0, -1, 0])),
                (transform((0, 0, 0.04)), np.array([0.0, -1, 0])),
            ]
        )
    q = np.array([0.1, 0.05, 0.35, 0.3, -0.06, -0.04, 0.3, 0.35])
    J_a = np.zeros((2, 8))
    J_a[0, 2], J_a[0, 3], J_a[1, 6], J_a[1, 7] = 0.009, 0.008, 0.009, 0.008
    return build(
        fingers,
        q,
        J_a,
        np.tile([0.2, 0.25, 0.2, 0.15], 2),
        tip=(0.0, 0.0, 0.03),
        rho=0.008,
        normals=[[1.0, 0.08, 0.05], [-1.0, 0.06, -0.03]],
        contact_links=["f0_l3", "f1_l3"],
        grip=grip,
        lam=-20.0,
        gamma=0.03,
        com=kw.pop("com", (0.0, 0.0, 0.0)),
        **kw,
    )


def planar_two_finger(pinned=False, grip=1.5, **kw):
    """Two fingers of two joints in the x-y plane, two tendons; gravity along -y."""
    fingers, z = [], np.array([0.0, 0.0, 1.0])
    for side in (1.0, -1.0):
        fingers.append(
            [(transform((0.04 * side, 0.0, 0.0)), side * z), (transform((0.0, 0.04, 0.0)), side * z)]
        )
    q = np.array([0.3, 0.35, 0.25, 0.4])
    J_a = np.zeros((2, 4))
    J_a[0, :2], J_a[1, 2:] = (0.009, 0.008), (0.009, 0.008)
    return build(
        fingers,
        q,
        J_a,
        np.tile([0.2, 0.15], 2),
        tip=(0.0, 0.03, 0.0),
        rho=0.008,
        normals=[[1.0, 0.15, 0.0], [-1.0, 0.1, 0.0]],
        contact_links=["f0_l1", "f1_l1"],
        grip=grip,
        lam=-20.0,
        pinned=pinned,
        planar=(0.0, 0.0, 1.0),
        com=(0.002, -0.003, 0.0),
        **kw,
    )


def finite_difference_jacobian(solver, start, step, read=None):
    """Six-point central differences of exact equilibria: d(read)/da, by default the state increment."""
    columns = []
    read = read or (lambda e: e.state.minus(start.state))
    for k_a in range(len(start.a)):
        total = 0.0
        for k, weight in ((1, 45.0), (2, -9.0), (3, 1.0)):
            for sign in (1.0, -1.0):
                a = start.a.clone()
                a[k_a] += sign * k * step
                total = total + sign * weight * read(solver.moved(start, a))
        columns.append(total / (60 * step))
    return torch.stack(columns, dim=-1)


def scaled(J, n_q, length=0.03):
    """Translations in units of the object's size, so that one norm measures all rows."""
    scale = torch.ones(J.shape[-2], 1, dtype=J.dtype)
    scale[n_q : n_q + 3] = 1 / length
    return scale * J


def relative_error(J, truth, n_q):
    return float((scaled(J, n_q) - scaled(truth, n_q)).norm() / scaled(truth, n_q).norm())


def step_error_slope(solver, start, J, directions, sizes):
    """Order of ``|ds - J da|`` in ``|da|``, averaged over directions."""
    n_q = len(start.state.q)
    slopes = []
    for direction in directions:
        errors = []
        for size in sizes:
            exact = solver.moved(start, start.a + size * direction).state.minus(start.state)
            errors.append(float(scaled((exact - J @ (size * direction))[:, None], n_q).norm()))
        slopes.append(np.polyfit(np.log(sizes), np.log(errors), 1)[0])
    return np.array(slopes)
