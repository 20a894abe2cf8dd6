"""Contacts that slide, open and close: what is counted, and what the witness sees."""

import pandas
from slides import Witness, errors_table, told

from torch_ekm.simulation import SimulatedHand


def motion(slid: float, step: float | None, links: int = 0) -> dict:
    km = None if step is None else 5 * step
    return {"plant": "described", "slid": slid, "km": km, "step": step, "links": links, "ms": 2.0}


def test_errors_are_told_of_motions_that_slid_and_refusals_are_left_out() -> None:
    motions = pandas.DataFrame([motion(0.0, 0.05), motion(3e-4, 0.2, links=1), motion(3e-4, None)])
    assert told(motions) == "slid: KM 1.00, step 0.20 deg; a step 2.0 ms"
    kinds = {row[0]: row[1:] for row in errors_table(motions).text()}
    assert kinds["described: a link touches"] == ["1", "1.000", "1.000", "0.200", "0.200"]
    assert kinds["described: all"][0] == "2"


def test_the_witness_sees_no_slip_at_rest() -> None:
    plant = SimulatedHand("icub_right", "box", engine="mujoco")
    plant.reset(0)
    witness = Witness(plant)
    plant.wait(0.2)
    assert len(witness.frames) > 0
    assert max(witness.slips().values()) < 2e-6
    plant.close()
