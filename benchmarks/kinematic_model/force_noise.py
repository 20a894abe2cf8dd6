"""The contact-force problem with a noisy state: how often is it solved, and is friction kept?

    python benchmarks/kinematic_model/force_noise.py --draws 1000 --seed 1000

The iCub hand pinches a box (or a can) in exact equilibrium; joint angles and orientation get 0.5 deg, the
position 0.5 mm of noise (standard deviations, every joint and axis).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "model"))

from model_icub import gripped
from test_model_icub import noisy_states

from torch_ekm.model import KinematicModel, ModelOptions


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for shape in ("box", "can"):
        model, solver, at = gripped(shape)
        flagged = ModelOptions(**{**vars(model.options), "on_unstable": "flag"})
        model = KinematicModel(
            model.hand, model.obj, flagged, kinematics=model.kinematics, detector=model.detector
        )
        exact = solver.forces(at).mu
        solved, violation, errors = 0, 0.0, []
        for state in noisy_states(at, options.draws, options.seed):
            contacts = solver.surfaces(state.q, state.position, state.rotation)
            forces = model.linearize(state, contacts).forces
            solved += forces.solved
            if forces.solved:
                violation = max(violation, -float(forces.margin.min()))
                errors.append(float((forces.mu - exact).norm() / exact.norm()))
        print(
            f"{shape}: solved {solved} of {options.draws}, friction violated by at most {violation:.1e} N, "
            f"median error of mu {100 * np.median(errors):.0f} %"
        )


if __name__ == "__main__":
    main()
