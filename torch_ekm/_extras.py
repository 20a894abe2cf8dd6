"""Packages that may be missing: import them, or name the extra that brings them; their versions."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType

from .exceptions import MissingExtraError

_BRINGS = {
    "robot": ("pytorch_kinematics", "yourdfpy", "trimesh", "coal", "qpsolvers", "clarabel", "scipy"),
    "sim": ("sapien", "cv2", "h5py", "filelock", "threadpoolctl"),
    "plots": ("matplotlib", "jinja2", "typer", "rich"),
    "experiments": ("joblib", "pandas", "pyvista"),
    "notebooks": ("IPython", "pyarrow"),
    "peers": ("river",),
    "fast": ("numba",),
    "mujoco": ("mujoco",),
    "dynamixel": ("dynamixel_sdk",),
    "ros2": ("rclpy", "sensor_msgs", "trajectory_msgs", "geometry_msgs", "std_msgs"),
    "interop": ("casadi", "rosbags"),
}
_EXTRA_OF = {module: extra for extra, modules in _BRINGS.items() for module in modules}


def require(module: str, extra: str | None = None) -> ModuleType:
    """Import ``module``, whose root must be in the table above, and return it.

    Args:
        extra: the one to name, where several bring it; None: that of the table.

    Raises:
        MissingExtraError: it is not installed; the message names the extra.
    """
    root = module.split(".")[0]
    extra = extra or _EXTRA_OF[root]
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.split(".")[0] != root:
            raise  # the package is there and something inside it is broken: do not hide it
        raise MissingExtraError(root, extra) from None


def versions_of(packages: Iterable[str]) -> dict[str, str]:
    """Versions of Python and of the named distributions; "not installed" where there is none."""
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
