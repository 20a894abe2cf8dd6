"""Vision and Hall sensors in the loop."""

import torch

from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.runner import Bench
from torch_ekm.simulation import PRESETS


def test_object_is_turned_with_camera_and_hall_sensors() -> None:
    bench = Bench(Setting(engine="mujoco", sensing=True), "box", "E-KM")
    record = bench.trial(0, 0, 6.0)
    assert record.reason == "reached", record.message
    assert (record.true_error_deg or 9) < 0.5  # truth is only looked at afterwards


def test_a_stuck_hall_channel_keeps_its_first_reading() -> None:
    bench = Bench(
        Setting(sensing=True, plant=PRESETS["nominal"].replace(stuck_joints=("index_3",))), "box", "KM"
    )
    assert bench.grasp(0, 0) is not None
    names = [sensor.joint for sensor in sorted(bench.hand.hand.hall_sensors, key=lambda s: s.channel)]
    before = bench.plant.observe().info["raw"]["hall"]
    index = bench.hand.hand.actuator_names.index("index_distal")
    delta = torch.zeros(bench.hand.hand.n_a, dtype=torch.float64)
    delta[index] = -0.5  # it straightens index_2 and index_3
    after = bench.plant.command(delta).info["raw"]["hall"]
    assert after[names.index("index_3")] == before[names.index("index_3")]
    assert after[names.index("index_2")] != before[names.index("index_2")]


def test_bench_takes_the_mean_of_as_many_frames_as_it_is_told() -> None:
    spread = []
    for frames in (1, 6):
        bench = Bench(Setting(frames=frames), "box", "KM+S")
        bench.plant.reset(0)
        spread.append(torch.stack([bench.plant.observe().position for _ in range(40)]).std(0).mean())
    assert float(spread[1] / spread[0]) < 0.6
