"""A grid of conditions: friction, mass and size of the object, orientation of the palm, left hand, grasps.

    python benchmarks/grid.py --objects box,can --seeds 1000:1010 --engine mujoco --out FOLDER

Preset "nominal" with every pair of friction and mass, and with one other change at a time: size, palm, the
left hand, centred grasps. Turns of 9, 19 and 27 deg; the E-KM has three turns of warm-up with the object.
Finished sessions stay in ``--out``: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from any_hand import Turns, records_by, turns_of
from command_line import study_parser

from torch_ekm._terminal import progress
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.jobs import run_jobs
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.plots import new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.simulation import PlantConfig, preset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTROLLERS = ("E-KM", "KM+I")
ANGLES = (9.0, 19.0, 27.0)
WARM_UP = 3
#: Factors on the description's friction and mass; each pair is a cell.
FRICTION, MASS = (0.4, 0.6, 0.8, 1.0, 1.2), (0.5, 1.0, 2.0, 3.0)
_G = 9.81  # [m/s^2]
_PALM = {
    "fingers down": (_G, 0.0, 0.0),
    "fingers up": (-_G, 0.0, 0.0),
    "index down": (0.0, -_G, 0.0),
    "index up": (0.0, _G, 0.0),
}
_COLOURS = 0.05, 5.0  # errors at the ends of the colours [deg]


def _pair(friction: float, mass: float) -> str:
    return f"friction {friction:g}, mass {mass:g}"


def cells(engine: str) -> dict[str, Setting]:
    """Name -> the setting; the palm faces down, and the hand is the right one, unless the name says so."""
    base, nominal = Setting(engine=engine), preset("nominal")
    pairs = itertools.product(FRICTION, MASS)
    found = {_pair(f, m): base.replace(plant=nominal.replace(friction=f, mass=m)) for f, m in pairs}
    for scale in (0.85, 1.15):
        found[f"size {scale:g}"] = base.replace(plant=nominal.replace(object_scale=scale))
    for name, gravity in _PALM.items():
        found[name] = base.replace(config=PlantConfig(gravity=gravity))
    found["left hand"] = base.replace(hand="icub_left")
    found["centred grasps"] = base.replace(config=PlantConfig(spread=0.0))
    return found


def session(setting: Setting, item: str, controller: str, seed: int) -> list[dict[str, Any]]:
    """Warm-up (E-KM only), then the turns: how each ended."""
    return turns_of(setting, item, controller, seed, ANGLES, WARM_UP)


class Grid:
    """All turns, by cell and controller."""

    def __init__(self, turns: Mapping[tuple[str, str], Sequence[TrialRecord]]) -> None:
        self.turns = turns
        self.cells = list(dict.fromkeys(cell for cell, _ in turns))

    def of(self, controller: str, cell: str | None = None) -> Turns:
        """Those of one cell, or of all."""
        found = (mine for key, mine in self.turns.items() if key[1] == controller and cell in (None, key[0]))
        return Turns(tuple(itertools.chain.from_iterable(found)))

    @property
    def verdict(self) -> str:
        """The last line."""
        ours, theirs = (self.of(name) for name in CONTROLLERS)
        return (
            f"E-KM lost {ours.lost} of {len(ours.records)}, reached {ours.reached},"
            f" error {ours.error:.2f} deg; KM+I lost {theirs.lost}, reached {theirs.reached},"
            f" error {theirs.error:.2f} deg"
        )

    def table(self) -> Table:
        """A row for each cell."""
        rows: list[list[Cell]] = []
        for cell in (*self.cells, None):
            found = [self.of(name, cell) for name in CONTROLLERS]
            figures = ((one.lost, one.reached, one.error) for one in found)
            turns = len(found[0].records)
            rows.append([cell or "all", turns, *itertools.chain.from_iterable(figures)])
        columns: list[str | Column] = ["cell", "turns"]
        columns += [f"{name} {what}" for name in CONTROLLERS for what in ("lost", "reached", "error [deg]")]
        note = (
            "Turns that had a grasp. Mean true error at the end, lost objects with the whole angle. Friction,"
            " mass and size: factors on the description's (preset nominal: 0.9, 1.1, 1)."
        )
        return Table("grid", "Each cell", columns, rows, note)

    def ends(self) -> Table:
        """How the turns ended that did not reach their target."""
        rows: list[list[Cell]] = []
        for cell in self.cells:
            ends = [self.of(name, cell).other_ends for name in CONTROLLERS]
            if any(ends):
                rows.append([cell, *ends])
        return Table("ends", "Lost, or not reached", ["cell", *CONTROLLERS], rows)

    def picture(self) -> Figure:
        """A heat map of each controller: friction and mass, and beside it the other cells."""
        figure, axes = new_figure(9.0, 5.6, 2, 2)
        pairs = [[_pair(f, m) for f in FRICTION] for m in MASS]
        listed = {name for row in pairs for name in row}
        others = [cell for cell in self.cells if cell not in listed]
        others += [""] * (-len(others) % 2)
        for name, (left, right) in zip(CONTROLLERS, (axes[:2], axes[2:]), strict=True):
            self._map(left, name, pairs, named=False)
            left.set_xticks(range(len(FRICTION)), [f"{f:g}" for f in FRICTION])
            left.set_yticks(range(len(MASS)), [f"{m:g}" for m in MASS])
            left.set(xlabel="friction", ylabel="mass", title=name)
            if others:
                self._map(right, name, [others[k : k + 2] for k in range(0, len(others), 2)], named=True)
            right.set_xticks([])
            right.set_yticks([])
            right.set(title=f"{name}, other changes")
        return figure

    def _map(self, axis: Any, controller: str, shown: list[list[str]], named: bool) -> None:
        """Colours by the error; in each cell the error, and how many objects were lost."""
        error = np.array([[self.of(controller, cell).error for cell in row] for row in shown])
        low, high = np.log(_COLOURS)
        share = (np.log(np.maximum(error, 1e-3)) - low) / (high - low)
        axis.imshow(share, cmap="cividis_r", vmin=0, vmax=1, aspect="auto")
        for (i, k), wrong in np.ndenumerate(error):
            turns, cell = self.of(controller, shown[i][k]), shown[i][k]
            if not turns.records:
                continue
            text = f"{wrong:.2f}" + (f"\n{turns.lost} lost" if turns.lost else "")
            colour = "white" if share[i, k] > 0.5 else "black"
            said = f"{cell}\n{text}" if named else text
            axis.text(k, i, said, ha="center", va="center", color=colour, fontsize=7)
        axis.grid(visible=False)

    def report(self, folder: Path, engine: str) -> Report:
        """Tables, picture and verdict, in ``folder``."""
        caption = "Mean true error at the end of the turns [deg], and objects lost; dark: 5 deg and more."
        shown = save_figure(self.picture(), folder, f"grid_{engine}", caption)
        tables = [table for table in (self.table(), self.ends()) if table.rows]
        report = Report("A grid of conditions", f"{self.verdict}.", tables, [shown])
        report.write(folder)
        return report


def main(arguments: Sequence[str] | None = None) -> None:
    parser = study_parser(
        __doc__, "grid", objects="box,can", seeds="1000:1010", engine="mujoco",
        quick="one cell, object and seed",
    )  # fmt: skip
    parser.add_argument("--cells", default="", help="names separated by semicolons; all if left out")
    given = parser.parse_args(arguments)
    objects, seeds, found = given.objects.split(","), given.seeds, cells(given.engine)
    wanted = [name.strip() for name in given.cells.split(";")] if given.cells else list(found)
    if unknown := set(wanted) - set(found):
        parser.error(f"no cell {', '.join(sorted(unknown))}; there are {'; '.join(found)}")
    if given.quick:
        wanted, objects, seeds = ["centred grasps"], objects[:1], seeds[:1]
    todo, keys = {}, {}
    for cell, seed, item, name in itertools.product(wanted, seeds, objects, CONTROLLERS):
        own = digest(found[cell], (item,), ANGLES, WARM_UP)
        job = f"{cell.replace(' ', '_').replace(',', '')}_{object_name(item)}_{name}_{own}_{seed}"
        todo[job], keys[job] = (found[cell], item, name, seed), (cell, name)
    with progress("running", len(todo)) as advance:
        results = run_jobs(session, todo, given.out, given.jobs, advance)
    grid = Grid(records_by(keys, results))
    print(grid.report(given.out, given.engine).markdown())
    print(grid.verdict)


if __name__ == "__main__":
    main()
