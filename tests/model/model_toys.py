"""Small hands for the tests: joints in chains, ball fingertips, kinematics of their own."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from equilibrium import Equilibrium, EquilibriumSolver, known_forces
from scipy.spatial.transform import Rotation
from torch import nn

from torch_ekm.contact.contacts import SHARED, VARYING, ContactSet, constraint_matrix
from torch_ekm.description import Actuator, HandDescription
from torch_ekm.description.urdf import UrdfModel
from torch_ekm.kinematics import GraspState, LinkPoses
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.model.stiffness import gravity_gradient

F64 = torch.float64


class ChainKinematics(nn.Module):
    """Fingers of revolute joints: (origin relative to the predecessor, axis) of each."""

    dtype = F64
    upstream: torch.Tensor

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
        lower = [torch.ones(n, n, dtype=torch.bool).tril() for n in self.lengths]
        self.register_buffer("upstream", torch.block_diag(*lower))

    def forward(self, q):
        turns = torch.zeros(*q.shape, 4, 4, dtype=F64)
        turns[..., 3, 3] = 1
        turns[..., :3, :3] = exp(q[..., None] * self.axes)
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
    """An object's inertia; its surfaces are in the contacts."""

    mass: float
    com: tuple[float, float, float]


def toy_hand(J_a, springs, rest, *, tendon=True, stiffness=np.inf, planar=None):
    J_a = np.atleast_2d(np.asarray(J_a, dtype=float))
    n_a, n_q = J_a.shape
    return HandDescription(
        name="toy",
        urdf=UrdfModel(Path("toy.urdf"), "toy", (), (), "palm"),
        transmission_path=Path("toy.toml"),
        base_link="palm",
        link_names=tuple(f"l{j}" for j in range(n_q)),
        joint_names=tuple(f"j{j}" for j in range(n_q)),
        joint_lower=np.full(n_q, -3.0),
        joint_upper=np.full(n_q, 3.0),
        actuators=tuple(
            Actuator(f"a{k}", -10.0, 10.0, tendon=tendon, stiffness=stiffness) for k in range(n_a)
        ),
        actuation_jacobian=J_a,
        coupling=np.zeros((0, n_q)),
        spring_stiffness=np.asarray(springs, dtype=float),
        spring_rest=np.asarray(rest, dtype=float),
        joint_friction=np.zeros(n_q),
        pads=(),
        planar_normal=planar,
        gravity=(0.0, -9.81, 0.0) if planar else (0.0, 0.0, -9.81),
    )


def transform(xyz, rpy=(0.0, 0.0, 0.0)):
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return placed


def isotropic(normal: torch.Tensor, curvature: float) -> torch.Tensor:
    return curvature * (torch.eye(3, dtype=F64) - normal[..., :, None] * normal[..., None, :])


def contact_set(links, points, normals, k_f, k_o=0.0, *, friction=3.0, gamma=0.0, pinned=False) -> ContactSet:
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
    return contacts.replace(
        **{name: getattr(contacts, name)[index] for name in (*VARYING, *SHARED)},
        **{name: tuple(getattr(contacts, name)[i] for i in index) for name in ("finger", "link", "pinned")},
    )


def stacked(*contacts: ContactSet) -> ContactSet:
    """One batch of contacts that differ in place only."""
    return contacts[0].replace(
        **{name: torch.stack([getattr(one, name) for one in contacts]) for name in VARYING}
    )


def batch_of(*states: GraspState) -> GraspState:
    parts = zip(*((s.q, s.position, s.rotation) for s in states), strict=True)
    return GraspState(*(torch.stack(part) for part in parts))


def changed(model: KinematicModel, *, contacts=None, options=None, obj=None, **hand) -> KinematicModel:
    """The model with other fields of its hand and options, another object, or other contacts."""
    return KinematicModel(
        dataclasses.replace(model.hand, **hand),
        obj or model.obj,
        dataclasses.replace(model.options, **(options or {})),
        kinematics=model.kinematics,
        detector=model.detector if contacts is None else lambda *_: contacts,
    )


@dataclass
class Toy:
    """A toy grasp in exact equilibrium: the spring rest angles are chosen so that it is at rest."""

    model: KinematicModel
    state: GraspState
    contacts: ContactSet
    mu: torch.Tensor
    lam: torch.Tensor
    a: torch.Tensor

    @property
    def unit(self):
        """What 1 is of each motor in the toy's own unit, metres of its tendon."""
        return torch.tensor([actuator.unit for actuator in self.model.hand.actuators], dtype=F64)

    def solver(self, **options):
        return EquilibriumSolver(self.model, self.state, self.contacts, **options)

    def forces(self):
        return known_forces(self.model.contact_kinematics(self.state, self.contacts), self.mu, self.lam)

    def equilibrium(self):
        return Equilibrium(self.state, self.a, self.mu, self.lam, torch.zeros(0, dtype=F64), self.contacts)


def build(
    fingers,
    q,
    J_a,
    springs,
    *,
    tip,
    normals,
    contact_links,
    rho=0.008,
    grip=1.5,
    com=(0.003, -0.002, 0.004),
    lam=-20.0,
    k_o=0.0,
    gamma=0.0,
    pinned=False,
    stiffness=np.inf,
    planar=None,
) -> Toy:
    """Fingers at q whose ball tips touch 50 g with the given normals, at rest with the given grip.

    ``lam`` is in the unit of ``J_a``, as ``stiffness`` is.
    """
    kin = ChainKinematics(fingers)
    q = torch.as_tensor(q, dtype=F64)
    n_q = len(q)
    poses = kin(q).transforms
    end = torch.tensor([*tip, 1.0], dtype=F64)
    tips = torch.stack([(poses[kin.link_names.index(name)] @ end)[:3] for name in contact_links])
    normals = torch.as_tensor(np.asarray(normals), dtype=F64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    contacts = contact_set(
        contact_links, tips - rho * normals, normals, 1 / rho, k_o, gamma=gamma, pinned=pinned
    )
    state = GraspState(q, contacts.point.mean(0), torch.eye(3, dtype=F64))

    def make(rest):
        hand = toy_hand(J_a, springs, rest, stiffness=stiffness, planar=planar)
        return KinematicModel(hand, ToyObject(0.05, com), kinematics=kin, detector=lambda *_: contacts)

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
    """Three fingers of three joints, three tendons (moment arms 9 and 8 mm)."""
    angles = np.array([0.0, 2.1, 4.2])
    tilt = np.array([0.1, -0.05, 0.08])
    return build(
        [radial_finger(t) for t in angles],
        [0.05, 0.35, 0.3, -0.08, 0.3, 0.4, 0.03, 0.4, 0.25],
        np.kron(np.eye(3), [0.0, 0.009, 0.008]),
        np.tile([0.25, 0.2, 0.15], 3),
        tip=(0.0, 0.0, 0.03),
        normals=np.stack([np.cos(angles + 0.1), np.sin(angles + 0.1), tilt], axis=-1),
        contact_links=["f0_l2", "f1_l2", "f2_l2"],
        grip=grip,
        pinned=pinned,
        **kw,
    )


def soft_two_finger(**kw):
    """Two fingers of four joints with soft ball tips, two tendons, object balls or planes."""
    fingers = []
    for angle in (0.0, np.pi):
        (base, abduction), flexion, far = radial_finger(angle)
        foot = (transform((0, 0, 0.005)), abduction)
        fingers.append([(base, np.array([0.0, 0, 1])), foot, flexion, far])
    return build(
        fingers,
        [0.1, 0.05, 0.35, 0.3, -0.06, -0.04, 0.3, 0.35],
        np.kron(np.eye(2), [0.0, 0.0, 0.009, 0.008]),
        np.tile([0.2, 0.25, 0.2, 0.15], 2),
        tip=(0.0, 0.0, 0.03),
        normals=[[1.0, 0.08, 0.05], [-1.0, 0.06, -0.03]],
        contact_links=["f0_l3", "f1_l3"],
        gamma=0.03,
        **{"com": (0.0, 0.0, 0.0), **kw},
    )


def planar_two_finger(pinned=False, J_a=None, **kw):
    """Two fingers of two joints in the x-y plane, two tendons; gravity along -y."""
    z = np.array([0.0, 0.0, 1.0])
    fingers = [
        [(transform((0.04 * side, 0.0, 0.0)), side * z), (transform((0.0, 0.04, 0.0)), side * z)]
        for side in (1.0, -1.0)
    ]
    return build(
        fingers,
        [0.3, 0.35, 0.25, 0.4],
        np.kron(np.eye(2), [0.009, 0.008]) if J_a is None else J_a,
        np.tile([0.2, 0.15], 2),
        tip=(0.0, 0.03, 0.0),
        normals=[[1.0, 0.15, 0.0], [-1.0, 0.1, 0.0]],
        contact_links=["f0_l1", "f1_l1"],
        pinned=pinned,
        planar=(0.0, 0.0, 1.0),
        com=(0.002, -0.003, 0.0),
        **kw,
    )


def finite_difference_jacobian(solver, start, step, read=None):
    """Four-point central differences of exact equilibria: d(read)/da, by default the state increment."""
    columns = []
    read = read or (lambda e: e.state.minus(start.state))
    for k_a in range(len(start.a)):
        total = 0.0
        for k, weight in ((1, 8.0), (2, -1.0)):
            for sign in (1.0, -1.0):
                a = start.a.clone()
                a[k_a] += sign * k * step
                total = total + sign * weight * read(solver.moved(start, a))
        columns.append(total / (12 * step))
    return torch.stack(columns, dim=-1)


def scaled(J, n_q, length=0.03):
    """Translations in units of the object's size, so that one norm measures all rows."""
    scale = torch.ones(J.shape[-2], 1, dtype=J.dtype)
    scale[n_q : n_q + 3] = 1 / length
    return scale * J


def relative_error(J, truth, n_q):
    return float((scaled(J, n_q) - scaled(truth, n_q)).norm() / scaled(truth, n_q).norm())
