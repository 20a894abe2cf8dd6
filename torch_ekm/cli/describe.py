"""Commands about what the package holds: hands, objects, notebooks, versions."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

from .._files import make_folder
from .._terminal import console, print_table, say, say_next
from ..exceptions import DescriptionError, OutputError, ParameterError
from ._app import AN_OBJECT, app

import typer  # isort: skip
from typer import Argument, Option  # isort: skip


@app.command()
def hands(
    new: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Write NAME.transmission.toml next to this URDF or MJCF (.xml, .mjcf), to be filled in.",
        ),
    ] = None,
    base: Annotated[
        str | None, Option(metavar="LINK", help="With --new, of a robot: the hand is what this link carries.")
    ] = None,
) -> None:
    """List the hands of the package, or begin your own.

    With --new: all joints of the URDF with their limits, a coupling for each <mimic>, and examples of
    actuators and pads; of an MJCF, its own tendons, springs, couplings and actuators. Fill in what is marked
    with TODO; 'torch-ekm check NAME.urdf' lists what is missing.
    A file that is there is not overwritten.
    """
    from ..description import list_hands, load_hand, write_template
    from ..description.transmission_file import ASSUMED

    if new is not None:
        written = write_template(new, base)
        for line in written.read_text(encoding="utf-8").splitlines():
            if line.startswith(ASSUMED):
                say(f"Assumed:   {line.removeprefix(ASSUMED)}")
        say(f"Written:   {written.resolve()}")
        say_next(f"put a figure wherever TODO stands, then: torch-ekm check {new}")
        return
    found = [load_hand(name) for name in list_hands()]
    rows = [(hand.name, hand.n_q, hand.n_a, len(hand.pads), hand.urdf_path.name) for hand in found]
    print_table(("hand", "joints", "actuators", "contact pads", "URDF"), rows)
    say_next("torch-ekm show icub_right; one of your own: torch-ekm hands --new my.urdf")


@app.command()
def objects() -> None:
    """List the objects of the package: mass [g], friction, grasp width [mm] and shapes."""
    from ..description import list_objects, load_object
    from ..description.registry import list_cylinders

    rows = []
    for name in (*list_objects(), *list_cylinders()):
        obj = load_object(name)
        figures = f"{1e3 * obj.mass:.0f}", f"{obj.friction:g}", f"{1e3 * obj.grasp_width:.0f}"
        rows.append((name, *figures, ", ".join(shape.kind for shape in obj.shapes)))
    print_table(("object", "mass [g]", "friction [1]", "grasp width [mm]", "shapes"), rows)
    say_next("torch-ekm show icub_right --object can")


@app.command()
def check(
    hand: Annotated[str, Argument(help="A hand (see 'torch-ekm hands') or a path to a URDF.")] = "",
    object: Annotated[str, Argument(help=AN_OBJECT)] = "box",
    picture: Annotated[Path, Option(help="Picture of pads and contact frames.")] = Path("check.png"),
    plant: Annotated[
        Path | None, Option(metavar="TOML", help="A real hand's wiring file: its motors move by 1 deg.")
    ] = None,
    dry_run: Annotated[
        bool, Option(help="With --plant: read the bus, print the commands, move nothing.")
    ] = False,
    emulate: Annotated[
        bool, Option(help="With --plant: without the hand, which then is wired as the file says.")
    ] = False,
) -> None:
    """Check a hand, from its files to a pinch of an object; or the wiring of a real one.

    Files, pads, axes, limits, tendons, and a pinch of the object in simulation and model. With --plant:
    signs, units, order, zeros and sensors of a real hand, by motions of 1 deg (up to 4 where its motors
    stick), one motor after the other. Each row has what was found and the remedy. Ends with 1 if there is
    an error, with 0 if not.
    """
    from ..inspection import Check

    if plant is None and (dry_run or emulate):
        raise ParameterError("plant", plant, "given with --dry-run or --emulate: a wiring file")
    if plant is not None:
        if hand:
            raise ParameterError("hand", hand, "left out: with --plant the wiring file names the hand")
        from ..drivers import open_driver
        from ..inspection.check_plant import check_plant

        with open_driver(plant, emulate=emulate, dry_run=dry_run, say=say) as driver:
            rows = check_plant(driver, driver.hand)
    elif not hand:
        raise ParameterError("hand", hand, "a hand or a path to a URDF; or --plant with a wiring file")
    else:
        from ..inspection.check import check_hand

        if picture.is_dir() or not picture.resolve().parent.is_dir():
            raise OutputError(picture, "there is no such folder, or a folder of this name")
        if picture.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise ParameterError("file", str(picture), "a name that ends in .png, .jpg, .jpeg")
        with console.status("Checking: some seconds, a minute or two where the pinch fails"):
            rows = check_hand(hand, object, picture)
    # a table breaks lines, and what is pasted must have none
    parts = [row.remedy.partition(": <") for row in rows]
    shown = [row._replace(remedy=part[0]) for row, part in zip(rows, parts, strict=True)]
    print_table(Check._fields, shown, hand if plant is None else str(plant))
    for row, (where, shape, rest) in zip(rows, parts, strict=True):
        if shape:
            say(f"{row.name}: {where}:\n{shape[2:]}{rest}")
    if any(row.state == "error" for row in rows):
        say_next("mend the first error; then the same command again")
        raise typer.Exit(1)
    dry = f"with the hand: torch-ekm check --plant {plant}{' --dry-run' if emulate else ''}"
    real = dry if emulate or dry_run else f"torch-ekm identify-servo --plant {plant}"
    say_next(f"torch-ekm show {hand} --object {object} --reach" if plant is None else real)


@app.command()
def notebooks(
    copy: Annotated[Path | None, Option(help="Copy them into this folder.")] = None,
) -> None:
    """List the notebooks of the package, or copy them."""
    found = sorted(notebook_folder().glob("[0-9]*.ipynb"))
    for path in found if copy is None else copy_notebooks(copy):
        say(str(path))
    say_next("torch-ekm notebooks --copy DIR" if copy is None else f"jupyter lab {copy}")


def notebook_folder() -> Path:
    """Find the notebooks: in the installed package, or in the checkout.

    Raises:
        DescriptionError: in neither.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_notebooks", package.parent / "notebooks"):
        if any(folder.glob("[0-9]*.ipynb")):
            return folder
    raise DescriptionError(package, "the notebooks are missing from this installation; install it again")


def copy_notebooks(folder: Path) -> list[Path]:
    """Copy all notebooks into ``folder`` (made if it is not there) and return the copies' paths.

    Raises:
        DescriptionError: one of them is there already; nothing is copied.
    """
    sources = sorted(notebook_folder().glob("[0-9]*.ipynb"))
    copies = [folder / source.name for source in sources]
    present = [copy.name for copy in copies if copy.exists()]
    if present:
        raise DescriptionError(folder, f"{', '.join(present)} would be overwritten; name another folder")
    if folder.exists() and not folder.is_dir():
        raise DescriptionError(folder, "this is a file; name a folder")
    make_folder(folder)
    return [Path(shutil.copyfile(*pair)) for pair in zip(sources, copies, strict=True)]


@app.command()
def version() -> None:
    """Print the versions that decide the numbers."""
    from ..experiments.reporting.report import versions

    for package, number in versions().items():
        say(f"{package} {number}")
