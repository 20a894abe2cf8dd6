"""Draw the figures of the explanation pages: ``python docs/figures.py`` writes ``docs/images/*.svg``.

Transparent ground and mid-grey lettering, legible on light and dark pages alike. What can be computed is
computed by the package: forces and lever arms of the grasp, the servo's inverse, both posteriors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle

from torch_ekm.kinematics import ServoModel
from torch_ekm.residual import SparseOnlineGP, SquaredExponential

IMAGES = Path(__file__).parent / "images"
INK, BLUE, ORANGE, GREEN = "#7a7a7a", "#3b82c4", "#d9822b", "#3f9e5a"
STYLE = {
    "svg.fonttype": "path", "svg.hashsalt": "torch_ekm", "font.family": "DejaVu Sans", "font.size": 10,
    "text.color": INK, "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.spines.top": False, "axes.spines.right": False, "lines.linewidth": 1.6, "legend.frameon": False,
    "mathtext.fontset": "dejavusans",
}  # fmt: skip


def _arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], color: str = INK) -> None:
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.5})


def _bare(width: float, height: float) -> tuple[Figure, Axes]:
    figure, ax = plt.subplots(figsize=(width, height))
    ax.set_aspect("equal")
    ax.axis("off")
    return figure, ax


def grasp_by_hand() -> Figure:
    """The planar grasp of the worked example, to scale [mm]."""
    figure, ax = _bare(5.2, 4.0)
    h, reach, ball, half = 40 + 30 * math.cos(math.pi / 6), 30 * math.sin(math.pi / 6), 6.0, 9.0
    ax.add_patch(Rectangle((-half, h - 15), 2 * half, 30, fill=False, ec=ORANGE, lw=1.6))
    for side in (-1, 1):
        x = [30 * side, 30 * side, (30 - reach) * side]
        ax.plot(x, [0, 40, h], color=BLUE, lw=4, solid_capstyle="round", alpha=0.6)
        ax.plot(x[:2], [0, 40], "o", color=BLUE, ms=8)
        ax.add_patch(Circle((x[2], h), ball, fill=False, ec=BLUE, lw=1.6))
        _arrow(ax, (side * (half + 12), h + 9), (side * half, h + 9), GREEN)
        ax.plot([side * half], [h], "o", color=GREEN, ms=4)
    ax.text(-half - 9, h + 11, "$f$", color=GREEN, ha="center")
    ax.text(half + 9, h + 11, "$f$", color=GREEN, ha="center")
    ax.text(0, h + 3, "box", color=ORANGE, ha="center")
    ax.text(-36, 0, "$q_0$", ha="right", va="center")
    ax.text(-36, 40, "$q_1$", ha="right", va="center")
    for x, y, text in ((66, 0, "66.0 mm"), (40, 40, "26.0 mm")):
        ax.plot([30, x + 2], [y, y], color=INK, lw=0.6)
        ax.annotate("", (x, y), (x, h), arrowprops={"arrowstyle": "<->", "color": INK, "lw": 0.8})
        ax.text(x + 2, (y + h) / 2 if y else 20, text, va="center")
    ax.plot([half, 68], [h, h], color=INK, lw=0.6)
    ax.plot([-half, -half], [h, 20], color=INK, lw=0.6, ls=":")
    ax.annotate("", (-30, 22), (-half, 22), arrowprops={"arrowstyle": "<->", "color": INK, "lw": 0.8})
    ax.text(-(30 + half) / 2, 14, "21 mm", ha="center")
    ax.annotate(
        "$y$", (0, 20), (0, 4), ha="center", arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 0.8}
    )
    ax.set_xlim(-50, 92)
    ax.set_ylim(-6, 86)
    return figure


def loop() -> Figure:
    """What goes round in one movement of the E-KM."""
    figure, ax = _bare(7.2, 2.9)

    def box(x: float, y: float, text: str, color: str, width: float = 1.7) -> None:
        style = "round,pad=0.04,rounding_size=0.08"
        patch = FancyBboxPatch((x - width / 2, y - 0.32), width, 0.64, boxstyle=style, fc="none", ec=color)
        patch.set_linewidth(1.5)
        ax.add_patch(patch)
        ax.text(x, y, text, ha="center", va="center", color=color)

    box(1.0, 2.2, "look:\nreached?", INK, 1.5)
    box(3.3, 2.2, "plan on $f + g$\npieces, bands", BLUE)
    box(5.6, 2.2, "servo inverse", BLUE)
    box(7.9, 2.2, "hand, object", ORANGE)
    box(7.9, 0.6, "sensors,\nguards", INK)
    box(5.6, 0.6, "dead zone,\nbias", GREEN)
    box(3.3, 0.6, "learner $g$,\nhand figures", GREEN)
    for x, text in ((2.1, "$e$"), (4.45, "$w$"), (6.75, "$v$")):
        _arrow(ax, (x - 0.24, 2.2), (x + 0.24, 2.2))
        ax.text(x, 2.36, text, ha="center")
    _arrow(ax, (7.9, 1.84), (7.9, 0.96))
    _arrow(ax, (7.0, 0.6), (6.52, 0.6), GREEN)
    ax.text(6.76, 0.76, "$w$", ha="center", color=GREEN)
    _arrow(ax, (5.6, 0.96), (5.6, 1.84), GREEN)
    ax.plot([7.9, 7.9, 3.3], [0.24, 0.0, 0.0], color=GREEN, lw=1.5)
    _arrow(ax, (3.3, 0.0), (3.3, 0.26), GREEN)
    ax.text(5.6, -0.22, r"$y = \delta s - f(s, w)$", ha="center", color=GREEN)
    _arrow(ax, (3.3, 0.96), (3.3, 1.84), GREEN)
    ax.plot([8.79, 9.2, 9.2, 1.0], [0.6, 0.6, 2.9, 2.9], color=INK, lw=1.5)
    _arrow(ax, (1.0, 2.9), (1.0, 2.56))
    ax.text(5.6, 2.99, "$q$, pose, encoders, fingertip forces", ha="center")
    ax.set_xlim(0.1, 9.4)
    ax.set_ylim(-0.4, 3.3)
    return figure


def servo_inverse() -> Figure:
    """Dead zone of 1.3 deg and bias of 0.2 deg: what a command does, and what undoes it."""
    figure, (plant, inverse) = plt.subplots(1, 2, figsize=(6.6, 2.8), layout="constrained")
    d, b = 1.3, 0.2
    v = np.linspace(-4, 4, 401)
    w = v + b - np.clip(v + b, -d, d)
    plant.plot(v, w, color=BLUE)
    plant.set_xlabel("commanded $v$ [deg]")
    plant.set_ylabel("moved $w$ [deg]")
    plant.annotate(
        "$d - b$", (d - b, 0), (1.4, -2.2), arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.8}
    )
    servo = ServoModel(["motor"])
    servo.estimate[:] = torch.deg2rad(torch.tensor([[d, b]]))
    wanted = torch.linspace(-3, 3, 601, dtype=torch.float64)
    commanded = torch.stack([servo.command(torch.deg2rad(one)[None])[0] for one in wanted]).rad2deg()
    for part in (wanted < -0.02, wanted > 0.02):
        inverse.plot(wanted[part], commanded[part], color=GREEN)
    inverse.plot([0], [0], "o", color=GREEN, ms=4)
    inverse.set_xlabel("wanted $w$ [deg]")
    inverse.set_ylabel("commanded $v$ [deg]")
    for ax in (plant, inverse):
        ax.plot([-3, 3], [-3, 3], color=INK, lw=0.8, ls="--")
        ax.axhline(0, color=INK, lw=0.5)
        ax.axvline(0, color=INK, lw=0.5)
        ax.patch.set_alpha(0)
    return figure


def sparse_gp() -> Figure:
    """60 samples in the order of their arrival: exact posterior, and that on eight basis vectors."""
    generator = torch.Generator().manual_seed(3)
    x = 6 * torch.rand(60, 1, generator=generator, dtype=torch.float64) - 3
    y = torch.sin(2 * x) + 0.4 * x + 0.15 * torch.randn(60, 1, generator=generator, dtype=torch.float64)
    options = {"noise_variance": 0.15**2, "standardize": False, "dtype": torch.float64}
    sparse = SparseOnlineGP(
        1, 1, capacity=8, kernel=SquaredExponential(1, lengthscale=0.8), parts=[], **options
    )
    sparse.update(x, y)
    at = torch.linspace(-3.3, 3.3, 200, dtype=torch.float64)[:, None]
    figure, ax = plt.subplots(figsize=(6.2, 2.6), layout="constrained")
    ours, kernel = sparse.predict(at), SquaredExponential(1, lengthscale=0.8)
    with torch.no_grad():
        gain = torch.linalg.solve(kernel(x, x) + 0.15**2 * torch.eye(60, dtype=x.dtype), kernel(x, at)).mT
        exact = (gain @ y)[:, 0], (kernel.diagonal(at) - (gain * kernel(at, x)).sum(-1)).sqrt()
    mean, half = ours.mean[:, 0], 1.645 * ours.stddev[:, 0]
    ax.fill_between(at[:, 0], mean - half, mean + half, color=BLUE, alpha=0.25, lw=0)
    ax.plot(at[:, 0], mean, color=BLUE, label="8 basis vectors")
    for sign in (-1, 0, 1):
        line = exact[0] + sign * 1.645 * exact[1]
        ax.plot(at[:, 0], line, color=ORANGE, lw=1, ls="--", label=None if sign else "exact GP")
    ax.plot(x[:, 0], y[:, 0], ".", color=INK, ms=3)
    basis = sparse.basis_inputs[sparse.posterior.active > 0][:, 0]
    ax.plot(basis, torch.full_like(basis, -2.7), "^", color=BLUE, ms=6)
    ax.set_xlabel("$x$")
    ax.set_ylabel("$y$")
    ax.legend(loc="upper left", labelcolor=INK)
    ax.patch.set_alpha(0)
    return figure


FIGURES: tuple[Callable[[], Figure], ...] = (grasp_by_hand, loop, servo_inverse, sparse_gp)


def main() -> None:
    """Write all figures."""
    mpl.use("svg")
    IMAGES.mkdir(exist_ok=True)
    with mpl.rc_context(STYLE):
        for draw in FIGURES:
            figure = draw()
            path = IMAGES / f"{draw.__name__}.svg"
            figure.savefig(path, transparent=True, metadata={"Date": None}, bbox_inches="tight")
            plt.close(figure)
            print(path.name, path.stat().st_size)


if __name__ == "__main__":
    main()
