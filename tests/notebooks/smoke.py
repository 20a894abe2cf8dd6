"""Notebooks in their smallest size, to see that they run: `make notebooks-smoke`.

    python tests/notebooks/smoke.py FOLDER

Cells have the sizes that teach; here stands what is put in their place.
"""

import json
import sys
from pathlib import Path

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"

#: Notebook -> what stands in its code, and what is run instead.
SMALL = {
    "02": {"range(8)": "range(2)"},
    "03": {"max_steps=40": "max_steps=3", "(9, 14, 19, 24, 29)": "(9,)"},
    "04": {
        "SAMPLES, JOBS = 600, 2": (
            'LEARNERS = {k: LEARNERS[k] for k in ("model alone", "linear RLS", "SOGP plain", "SOGP")}\n'
            "SAMPLES, JOBS = 80, 1"
        ),
        '"simulated_hand", limit=400': '"simulated_hand", limit=60',
        "(name, limit=SAMPLES)": '(name, limit=680 if name == "t42" else SAMPLES)',
        "compare(mine, learners)": "compare(mine, learners, limit=60)",
        '    "river forest": RiverResidual,\n': "",
    },
    "05": {
        "results = run_jobs(planned.protocol.run, jobs, Path(tempfile.mkdtemp()), 2)": (
            "planned = plan(name, REPORTED_SEEDS[:1], quick=True)\n"
            "        jobs = {job: one for job, one in planned.jobs.items() if {*controllers} & {*one}}\n"
            "        results = run_jobs(planned.protocol.run, jobs, Path(tempfile.mkdtemp()))"
        )
    },
    "06": {"range(400)": "range(60)"},
    "07": {"(8, 14, 20)": "(5,)", "degrees=18": "degrees=4", "(-1, 1, 1)": "(-1, 1)"},
}


def small(path: Path) -> str:
    """A notebook with its small sizes.

    Raises:
        ValueError: it does not hold what is to be replaced.
    """
    notebook, left = json.loads(path.read_text(encoding="utf-8")), dict(SMALL.get(path.name[:2], {}))
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code":
            for whole in [one for one in left if one in source]:
                source = source.replace(whole, left.pop(whole))
            cell["source"] = source
    if left:
        raise ValueError(f"{path.name} has no {list(left)}")
    return json.dumps(notebook)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for one in sorted(NOTEBOOKS.glob("[0-9]*.ipynb")):
        (folder / one.name).write_text(small(one), encoding="utf-8")
