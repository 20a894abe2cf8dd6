"""Look at a hand, a grasp or a log: in a browser while it is served, or as a page of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from ...description import list_hands, load_hand
from ...exceptions import OutputError, ParameterError, UnknownNameError
from ...rendering.web import draw, place, save_animation, start_server
from .hand import GraspShow, HandShow
from .reach import ReachShow
from .trial import LogShow

_RATE = 30.0  # [Hz] at which controls are looked at


#: Something to look at, with controls.
Show = HandShow | GraspShow | ReachShow | LogShow


def choose_show(what: str, object: str | None = None, seed: int = 0, reach: bool = False) -> Show:
    """A hand (name or URDF), alone or holding an object, or a log (folder, or one trial's file).

    Args:
        object: name or URDF.
        seed: which grasp of it.
        reach: how far it can be turned.

    Raises:
        UnknownNameError: no such hand, and no log of that name; the message lists the hands.
        ParameterError: an object was given to a log, or none to a hand whose reach is asked for.
        DescriptionError: the log is damaged or has nothing to show.
    """
    path = Path(what)
    if what not in list_hands() and path.suffix != ".urdf":
        if not path.exists():
            raise UnknownNameError("hand or log", what, (*list_hands(), "a URDF file", "a log's folder"))
        if object is not None:
            raise ParameterError("object", object, "left out with a log, which knows its own")
        return LogShow(path)
    if object is None:
        if reach:
            raise ParameterError("reach", reach, "False without an object: it is that of a grasp")
        return HandShow(load_hand(what))
    return (ReachShow if reach else GraspShow)(what, object, seed)


def save_page(show: Show, path: Path) -> Path:
    """Write a stand-alone page that any browser shows, without a network.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    if path.is_dir() or not path.resolve().parent.is_dir():
        raise OutputError(path, "there is no such folder, or a folder of this name")
    return save_animation(show.scene(), path)


def serve(
    show: Show,
    port: int = 8080,
    on_ready: Callable[[str], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Serve an interactive view to this machine until ``stop()`` or an interrupt.

    The server listens on 127.0.0.1 and answers who has the address with its secret, which is another one
    each time.

    Args:
        port: the next free one is taken if it is not.
        on_ready: called with the address to be opened.
        stop: asked 30 times a second.
    """
    server, address = start_server(port)
    try:
        scene = show.scene()
        nodes = draw(server, scene)
        place(server, nodes, scene.transforms[0])
        server.gui.set_panel_label(show.title)
        show.add_controls(server.gui)
        if on_ready is not None:
            on_ready(address)
        while not stop():
            moved = show.update()
            if moved is not None:
                place(server, nodes, moved)
            time.sleep(1 / _RATE)
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
