"""Import optional dependencies, or name the extra that brings them."""

from __future__ import annotations

import importlib
from types import ModuleType

from .exceptions import MissingExtraError

_EXTRA_OF = {
    "pytorch_kinematics": "robot",
    "yourdfpy": "robot",
    "trimesh": "robot",
    "coal": "robot",
    "qpsolvers": "robot",
    "clarabel": "robot",
    "scipy": "robot",
    "sapien": "sim",
    "cv2": "sim",
    "gymnasium": "sim",
    "h5py": "sim",
    "joblib": "experiments",
    "matplotlib": "experiments",
    "mpl_toolkits": "experiments",
    "jinja2": "experiments",
    "pyvista": "experiments",
    "viser": "experiments",
    "typer": "experiments",
    "rich": "experiments",
    "IPython": "notebooks",
    "pyarrow": "notebooks",
    "gpytorch": "peers",
    "river": "peers",
    "distributed": "cluster",
}


def require(module: str) -> ModuleType:
    """Import ``module``, whose root must be in the table above, and return it.

    Raises:
        MissingExtraError: it is not installed; the message names the extra.
    """
    root = module.split(".")[0]
    extra = _EXTRA_OF[root]
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.split(".")[0] != root:
            raise  # the package is there and something inside it is broken: do not hide it
        raise MissingExtraError(root, extra) from None
