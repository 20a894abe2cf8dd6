"""Import optional dependencies, or name the extra that brings them."""

from __future__ import annotations

import importlib
from types import ModuleType

from .exceptions import MissingExtraError

_BRINGS = {
    "robot": ("pytorch_kinematics", "yourdfpy", "trimesh", "coal", "qpsolvers", "clarabel", "scipy"),
    "sim": ("sapien", "cv2", "gymnasium", "h5py", "filelock", "threadpoolctl"),
    "plots": ("matplotlib", "jinja2", "typer", "rich"),
    "experiments": ("joblib", "pandas", "pyvista"),
    "notebooks": ("IPython", "pyarrow"),
    "peers": ("river",),
    "fast": ("numba",),
    "mujoco": ("mujoco",),
    "dynamixel": ("dynamixel_sdk",),
    "ros2": ("rclpy", "sensor_msgs", "trajectory_msgs", "geometry_msgs", "std_msgs"),
    "interop": ("onnx", "onnxscript", "casadi", "rosbags"),
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
