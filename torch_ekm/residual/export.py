"""A learner's predictions as a file that other runtimes read: ONNX, or torch.export's pt2."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn

from .._extras import require
from ..exceptions import ParameterError
from ..typing import Tensor

OUTPUTS = ("mean", "variance", "mean_jacobian", "variance_jacobian")


def export_learner(learner: Any, path: str | Path, format: str) -> Path:
    """Write the file of :meth:`torch_ekm.residual.ResidualLearner.export`, and return its path."""
    if format not in ("onnx", "pt2"):
        raise ParameterError("format", format, "'onnx' or 'pt2'")
    if not hasattr(learner, "predict_with_jacobians") or tuple(learner.batch_shape):
        valid = "a SparseOnlineGP or a MixtureResidual of such, one model (batch_shape ())"
        raise ParameterError("learner", f"{type(learner).__name__}{tuple(learner.batch_shape)}", valid)
    path = Path(path)
    module = _Predictions(copy.deepcopy(learner)).eval()
    two = torch.zeros(2, learner.in_features, dtype=learner.dtype, device=learner.device)
    rows = {"x": {0: torch.export.Dim("n", min=1)}}
    with _quiet(), torch.no_grad():
        program = torch.export.export(module, (two,), dynamic_shapes=rows, strict=False)
        if format == "pt2":
            torch.export.save(program, path)
        else:
            require("onnx")
            require("onnxscript")
            names = {"input_names": ["x"], "output_names": list(OUTPUTS)}
            made: Any = torch.onnx.export(program, (two,), dynamo=True, verbose=False, **names)
            made.save(str(path))
    return path


class _Predictions(nn.Module):
    """x ``(n, in)`` to what :meth:`predict_with_jacobians` gives, as plain tensors."""

    def __init__(self, learner: Any) -> None:
        super().__init__()
        self.learner = learner

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        prediction = self.learner.predict_with_jacobians(x)
        return prediction.mean, prediction.variance, prediction.mean_jacobian, prediction.variance_jacobian


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter logs packages and functions of its own that have nothing to do with a learner."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
