"""Files of a hand or an object as its owner has them: copies of the package's own, to be changed."""

from pathlib import Path

from torch_ekm.description import list_hands
from torch_ekm.description.registry import hand_paths, object_paths


def copied(folder: Path, name: str = "planar_two_finger", stem: str = "my") -> tuple[Path, Path]:
    """The URDF and the file beside it."""
    sources = hand_paths(name) if name in list_hands() else object_paths(name)
    copies = tuple(folder / f"{stem}{''.join(source.suffixes)}" for source in sources)
    for source, copy in zip(sources, copies, strict=True):
        copy.write_bytes(source.read_bytes())
    return copies  # pyright: ignore[reportReturnType]


def change(path: Path, old: str, new: str, count: int = 1) -> None:
    """In the text of a file; -1: at each place."""
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), encoding="utf-8")
