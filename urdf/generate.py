"""Write every URDF of this folder, with its transmission or object file.

    python urdf/generate.py            # write
    python urdf/generate.py --check    # exit with 1 if a file is not what would be written

The figures live in ``_icub.py``, ``_planar.py``, ``_t42.py`` and ``_objects.py``; README.md tells
where each one comes from. Sources: iKin (icub-main, BSD-3-Clause) and the iCub documentation
(BSD-3-Clause) for the kinematics, robots-configuration and icub-firmware for limits, actuators and Hall
sensors, icub-models for masses and for dimensions measured on its meshes, openhand-hardware for the T42.
Only figures were taken, no text and no mesh.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import _icub
import _objects
import _planar
import _t42

FOLDER = Path(__file__).resolve().parent


def files() -> dict[Path, str]:
    """Path relative to this folder -> text."""
    texts: dict[Path, str] = {}
    for side in ("right", "left"):
        texts[Path(f"icub_{side}_hand.urdf")] = _icub.urdf_text(left=side == "left")
        texts[Path(f"icub_{side}_hand.transmission.toml")] = _icub.transmission_text(left=side == "left")
    texts[Path("planar_two_finger.urdf")] = _planar.urdf_text()
    texts[Path("planar_two_finger.transmission.toml")] = _planar.transmission_text()
    texts[Path("yale_t42.urdf")] = _t42.urdf_text()
    texts[Path("yale_t42.transmission.toml")] = _t42.transmission_text()
    for thing in (*_objects.OBJECTS, *_objects.CYLINDERS):
        texts[Path("objects", f"{thing.name}.urdf")] = _objects.urdf_text(thing)
        texts[Path("objects", f"{thing.name}.object.toml")] = _objects.object_text(thing)
    return texts


def main() -> int:
    parser = argparse.ArgumentParser(description="Write the URDF files of this folder.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a file is out of date")
    check = parser.parse_args().check
    stale = []
    for name, text in files().items():
        path = FOLDER / name
        if check:
            if not path.is_file() or path.read_text(encoding="utf-8") != text:
                stale.append(str(name))
        else:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    if stale:
        print(f"out of date, run python urdf/generate.py: {', '.join(stale)}", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
