"""Log trials of any plant, check the files, and learn from them again without the plant.

    python examples/record_and_replay.py

The log goes to the folder "log"; started again, the script makes only what is missing.
"""

import torch

from torch_ekm.description.registry import file_digests
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel
from torch_ekm.plant import RecordingPlant, ReplayedPlant, TrialLog, verify_log
from torch_ekm.simulation import SimulatedHand

plant = RecordingPlant(SimulatedHand("planar_two_finger", "can", preset="nominal"))  # or your driver
draw = torch.Generator().manual_seed(0)
files = file_digests("planar_two_finger", ["can"])  # so that the log knows what it was made from
with TrialLog("log", {"hand": "planar_two_finger", "object": "can", "files": files}) as log:
    for trial in log.missing(range(2)):
        seen = plant.reset(trial)
        for _ in range(12):
            plant.command(0.1 * torch.rand(2, generator=draw, dtype=torch.float64) - 0.05)
        log.write(trial, plant.trajectory, {"reason": "done"})
for finding in verify_log("log"):  # every byte of every file
    print(*finding)

log = TrialLog.open("log")
model = KinematicModel(plant.hand, plant.object)
ekm = None
for trial in log.trials:
    trajectory = log.read(trial)
    replayed = ReplayedPlant(trajectory)  # a plant again: any loop can run on it
    seen = replayed.reset()
    ekm = EnhancedModel.for_grasp(model, seen.state) if ekm is None else ekm
    errors = []
    for command in trajectory.commands:
        after = replayed.command(command)
        happened, moved = after.state.minus(seen.state), after.a - seen.a
        alone, corrected = ekm.nominal(seen.state, moved), ekm(seen.state, moved).detach()
        errors.append([float((happened - guess)[-1].abs().rad2deg()) for guess in (alone, corrected)])
        ekm.update(seen.state, moved, happened)
        seen = after
    mean = torch.tensor(errors).mean(0)
    print(f"trial {trial}: error of one motion, model alone {mean[0]:.2f} deg, E-KM {mean[1]:.2f} deg")
