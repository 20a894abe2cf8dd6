"""What the adapters of GPyTorch's models share."""

from __future__ import annotations

import pickle
from typing import Any, ClassVar

from ..base import SingleLearner


class Rebuilt(SingleLearner):
    """A learner whose state lies partly outside of modules: a copy is made anew and loads its state."""

    _options: ClassVar[tuple[str, ...]]

    def __deepcopy__(self, memo: dict) -> Rebuilt:
        return pickle.loads(pickle.dumps(self))

    def __reduce__(self):
        options = {name: getattr(self, name) for name in (*self._options, "on_invalid", "dtype")}
        return _rebuild, (type(self), self.in_features, self.out_features, options, self.state_dict())


def _rebuild(kind: type[Rebuilt], n_in: int, n_out: int, options: dict[str, Any], state: dict) -> Rebuilt:
    learner = kind(n_in, n_out, **options)
    learner.load_state_dict(state)
    return learner
