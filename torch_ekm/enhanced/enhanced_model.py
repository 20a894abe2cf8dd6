"""f + g: any model of increments, corrected by any learner of its residual; the file of a learned one."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import nn

from .._checks import check_finite, check_kind, check_shape
from .._recorded import Recorded, check_state, describe
from ..exceptions import FileFormatError, NoStateError, ParameterError, ShapeError
from ..kinematics import GraspState
from ..residual.base import ResidualLearner
from ..residual.files import known_classes, read, rebuild, write
from ..residual.kernels.linear import ActionLinearKernel
from ..residual.report import Expected, UpdateReport
from ..typing import Float, Tensor
from .adaptive_model import differentiated, finite_differences
from .grasp import GraspEncoding, grasp_learner

if TYPE_CHECKING:
    from ..model import KinematicModel
    from ..model.linearization import FollowedFigures


class EnhancedModel(Recorded, nn.Module):
    """Enhanced model ``ds = f(s, da) + g(s, da)`` (eq. 3 of the E-KM paper).

    The learner ``g`` sees ``x = [encode(s); action_scale * da]`` and learns the residual
    ``y = (ds - f(s, da)) * output_scale`` of the selected outputs (eq. 9). Before its first
    update ``g = 0``, so ``f + g == f`` exactly.

    Args:
        model: any callable ``f(state, action) -> increment``; it may give arrays. If it has
            ``linearize(state)`` with a ``manipulation_jacobian`` J_m ``(n_s, n_a)``, then ``f = J_m da`` and
            J_m is its derivative.
        learner: a residual learner (see :mod:`torch_ekm.residual`) with
            ``in_features = dim(encode(s)) + dim(a)``.
        encode: turns the state into the learner's inputs ``(*batch, d)``; the identity if None
            (the state is then a tensor).
        outputs: indices of the increment that the learner corrects; all if None.
        action_scale: factor from the action's unit to the learner's.
        output_scale: factor, or one for each output, from the increment's unit to the learner's.
        jacobian: df/dda for :meth:`linearize`: a callable ``(state, action) -> (*batch, n_s, n_a)``, or
            ``"finite-difference"`` (central, 2 n_a calls of f); None: J_m, or automatic differentiation.

    Values have the dtype of the action.

    Raises:
        ParameterError: an argument is of another type, or ``outputs`` do not go with the learner.
    """

    def __init__(
        self,
        model: Callable[[Any, Tensor], Tensor],
        learner: ResidualLearner,
        *,
        encode: Callable[[Any], Tensor] | None = None,
        outputs: list[int] | None = None,
        action_scale: float = 1.0,
        output_scale: float | Float[Tensor, " n_out"] = 1.0,
        jacobian: Callable[[Any, Tensor], Any] | Literal["finite-difference"] | None = None,
    ) -> None:
        super().__init__()
        _check_arguments(model, learner, encode, outputs, jacobian)
        if not isinstance(action_scale, int | float) or not math.isfinite(action_scale) or action_scale == 0:
            raise ParameterError("action_scale", action_scale, "a finite number other than 0")
        scale = torch.as_tensor(math.nan if output_scale is None else output_scale)
        if scale.shape not in ((), (learner.out_features,)) or not bool(
            (scale.isfinite() & (scale != 0)).all()
        ):
            valid = f"a finite number other than 0, or one for each of {learner.out_features} outputs"
            raise ParameterError("output_scale", output_scale, valid)
        self.model: Any = model  # a Module is registered, any other callable is kept as it is
        self.learner: ResidualLearner = learner
        self.encode: Callable[[Any], Tensor] = nn.Identity() if encode is None else encode
        self.outputs = outputs
        self.action_scale = action_scale
        self.output_scale = nn.Buffer(scale)
        self.jacobian: Any = jacobian

    @classmethod
    def for_grasp(
        cls,
        model: KinematicModel,
        state: GraspState,
        learner: ResidualLearner | Callable[[int, int], ResidualLearner] | None = None,
        encode: GraspEncoding | None = None,
        figures: FollowedFigures | None = None,
    ) -> EnhancedModel:
        """An E-KM of a grasped object, with nothing learned yet.

        g corrects the object's six rows in mm and deg. It sees the joints of the fingers that touch and the
        object's pose, relative to ``state``, and the increments in units of 2 deg.

        Args:
            model: kinematic model of hand and object.
            state: of the grasp at the start.
            learner: of ``[encode(s); da]``, with 6 outputs, or a function ``(n_s, n_a)`` that makes one for
                ``n_s`` features of the state and ``n_a`` actuators:
                ``lambda n_s, n_a: SparseOnlineGP(n_s + n_a, 6)``.
                None: :func:`~torch_ekm.enhanced.grasp_learner`.
            encode: what it sees of a state; None: of this grasp.
            figures: of the hand, which f follows: :class:`~torch_ekm.control.HandFigures` learned before,
                or :class:`~torch_ekm.control.DescribedFigures`. None: those that the model follows,
                or new ones. A :class:`~torch_ekm.control.ClosedLoop` brings those of its knowledge.

        Raises:
            NoContactError: nothing touches the object.
            ParameterError: no model, or a learner of other inputs or outputs.
        """
        if not hasattr(model, "hand"):
            raise ParameterError("model", model, "a KinematicModel")
        n_q, n_a = state.q.shape[-1], model.hand.n_a
        if figures is None and model.figures is None:
            from ..estimation.hand_figures import HandFigures  # the model is slow to import

            figures = HandFigures.of(model.hand)
        model = model if figures is None else model.with_figures(figures)
        encode = GraspEncoding.of(model, state) if encode is None else encode
        if not isinstance(learner, ResidualLearner):
            adapts = model.figures is not None and model.figures.learns
            made = partial(grasp_learner, adapts=adapts) if learner is None else learner
            learner = made(encode.n_features, n_a) if callable(made) else made
        check_kind(
            "learner", learner, ResidualLearner, "a ResidualLearner, or a function (n_s, n_a) that makes one"
        )
        n_in, sizes = encode.n_features + n_a, (learner.in_features, learner.out_features)
        if sizes != (n_in, 6):
            valid = f"({n_in}, 6): inputs ({encode.n_features} of the state, {n_a} increments) and outputs"
            raise ParameterError(f"size of the learner {type(learner).__name__}", sizes, valid)
        scale = torch.tensor([1e3] * 3 + [180 / math.pi] * 3, dtype=state.q.dtype)  # m -> mm, rad -> deg
        rows = list(range(n_q, n_q + 6))
        step = math.radians(2.0)
        return cls(model, learner, encode=encode, outputs=rows, action_scale=1 / step, output_scale=scale)

    @property
    def affine(self) -> bool:
        """g is linear in the action, so one linearization says all about a state."""
        return isinstance(getattr(self.learner, "kernel", None), ActionLinearKernel)

    def features(self, state: Any, action: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_x"]:
        """``x = [encode(s); action_scale * da]``.

        Raises:
            ParameterError: the encoded state is no tensor, or the action none of floating-point numbers.
            ShapeError: the learner takes another number of entries.
        """
        scaled, encoded = self.action_scale * _checked_action(action), self.encode(state)
        if not isinstance(encoded, Tensor):
            raise ParameterError("state", type(encoded).__name__, "a tensor, or what encode= makes one of")
        known, given = self.learner.in_features, encoded.shape[-1] + scaled.shape[-1]
        if known != given:
            parts = f"state {encoded.shape[-1]} + action {scaled.shape[-1]}"
            raise ShapeError("learner's input", f"(..., {known})", (given,), f"it has {parts} entries")
        return torch.cat([encoded, scaled], dim=-1)

    def forward(self, state: Any, action: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_s"]:
        """``f(s, da) + g(s, da)``."""
        nominal = self.nominal(state, action)
        mean = self.learner(self.features(state, action)) / self.output_scale
        return nominal + self._scatter(mean, nominal)

    def nominal(self, state: Any, action: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_s"]:
        """``f(s, da)``, as a tensor of the action's dtype.

        Raises:
            ParameterError: the action is no tensor of floating-point numbers.
            ShapeError: f gives another number of entries than the learner corrects.
        """
        nominal = torch.as_tensor(self.model(state, _checked_action(action))).to(action)
        self._check_width("f(state, action)", nominal)
        return nominal

    def expect(self, state: Any, action: Float[Tensor, "*batch n_a"]) -> Expected:
        """A motion whose increment is measured some motions later, see
        :meth:`~torch_ekm.residual.ResidualLearner.expect`."""
        return self.learner.expect(self.features(state, action))

    @torch.no_grad()
    def update(
        self,
        state: Any,
        action: Float[Tensor, "*batch n_a"],
        increment: Float[Tensor, "*batch n_s"],
        nominal: Float[Tensor, "*batch n_s"] | None = None,
        expected: Expected | None = None,
    ) -> UpdateReport:
        """Train on one motion: ``y = ds - f(s, da)`` (eq. 9).

        Args:
            state: state before the motion.
            action: increment that was commanded.
            increment: what happened, ``ds``.
            nominal: ``f(s, da)`` if it is known already. None: it is computed, by a model that adapts
                (:class:`AdaptiveModel`, a KM with figures) after it has learned from the motion.
            expected: what :meth:`expect` gave of this state and action, where ``ds`` comes late.

        Returns:
            The learner's report.

        Raises:
            NonFiniteError: an entry is NaN or infinite; nothing was changed. With ``on_invalid="skip"`` the
                learner leaves the sample out instead and counts it in ``learner.n_refused``.
            ShapeError: the increment has not the shape of the model's prediction.
            ParameterError: state, action or increment is no tensor, or the action is one of integers.
        """
        if not isinstance(increment, Tensor):
            raise ParameterError(
                "increment", type(increment).__name__, "a tensor: torch.as_tensor(increment)"
            )
        x = self.features(state, action)
        if nominal is None and hasattr(self.model, "adapt"):  # what the learner refuses, f must not learn
            self._check_width("increment", increment)
            self.learner.check_query(x)
            if all(math.isfinite(value.square().sum()) for value in (increment, x)):
                self.model.adapt(state, action, increment)
        predicted = self.nominal(state, action) if nominal is None else nominal
        check_shape("increment", increment, predicted.shape, "as the prediction has")
        if self.learner.on_invalid == "raise":  # else the learner leaves such a sample out, and counts it
            for name, value in (
                ("action", action), ("state, as encoded,", x[..., : x.shape[-1] - action.shape[-1]]),
                ("increment", increment), ("f(state, action)", predicted),
            ):  # fmt: skip
                check_finite(name, value)
        residual = self._gather(increment - predicted) * self.output_scale
        return self.learner.update(x if expected is None else expected, residual)

    def new_sequence(self) -> None:
        """The next motion does not follow on the last one: a learner that carries its last error over (a
        :class:`~torch_ekm.residual.MixtureResidual`) drops it."""
        self.learner.new_sequence()

    def linearize(
        self,
        state: Any,
        action: Float[Tensor, "*batch n_a"],
        nominal_jacobian: Float[Tensor, "*batch n_s n_a"] | None = None,
    ) -> tuple[Float[Tensor, "*batch n_s"], Float[Tensor, "*batch n_s n_a"]]:
        """``(f + g, d(f + g)/d da)`` at a state and action, or at each of a batch.

        Args:
            nominal_jacobian: J_m if it is known already (then ``f = J_m da``).

        Raises:
            NoDerivativeError: f carries no derivative (numpy, ``no_grad``, a detached output).
            ShapeError: ``jacobian`` gave another shape.
        """
        nominal, J = self._nominal_with_jacobian(state, _checked_action(action), nominal_jacobian)
        mean, dmean = self.learner.linearize(self.features(state, action))
        value = nominal + self._scatter(mean / self.output_scale, nominal)
        dmean = dmean[..., -action.shape[-1] :]
        slope = (dmean * self.action_scale / self.output_scale.reshape(-1, 1)).to(J.dtype)
        if self.outputs is None:
            return value, J + slope
        jacobian = J.clone()
        jacobian[..., self.outputs, :] += slope
        return value, jacobian

    def _nominal_with_jacobian(
        self, state: Any, action: Tensor, J: Tensor | None
    ) -> tuple[Float[Tensor, "*batch n_s"], Float[Tensor, "*batch n_s n_a"]]:
        if J is None and self.jacobian is None and hasattr(self.model, "linearize"):
            J = self.model.linearize(state).manipulation_jacobian
        if J is not None:
            if action.shape[-1:] != J.shape[-1:]:
                raise ShapeError("action", f"(*batch, {J.shape[-1]})", action.shape)
            J = J.to(action)
            return (J @ action.unsqueeze(-1)).squeeze(-1), J
        if self.jacobian is None:
            return differentiated(self.nominal, state, action)
        nominal = self.nominal(state, action)
        if self.jacobian == "finite-difference":
            return nominal, finite_differences(self.nominal, state, action)
        J = torch.as_tensor(self.jacobian(state, action)).to(action)
        check_shape("jacobian", J, (*nominal.shape, action.shape[-1]))
        return nominal, J

    def correction(
        self, state: Any, action: Float[Tensor, "*batch n_a"], n_s: int
    ) -> tuple[Float[Tensor, "*batch n_s"], Float[Tensor, "*batch n_s"]]:
        """``g(s, da)`` and its variance, in the increment's unit and its square; 0 of what is not learned.

        f is not evaluated.

        Args:
            n_s: entries of an increment.
        """
        g = self.learner.predict(self.features(state, action))
        still = action.new_zeros(*action.shape[:-1], n_s)
        mean, variance = g.mean / self.output_scale, g.variance / self.output_scale**2
        return self._scatter(mean, still), self._scatter(variance, still)

    def predict(
        self, state: Any, action: Float[Tensor, "*batch n_a"], *, observation: bool = False
    ) -> torch.distributions.Normal:
        """Distribution of the learned outputs' increment, in the increment's unit.

        Args:
            observation: of what will be measured, noise included; else of ``f + g`` alone.
        """
        nominal = self._gather(self.nominal(state, action))
        g = self.learner.predict(self.features(state, action), observation=observation)
        mean, deviation = (value / self.output_scale for value in (g.mean, g.stddev))
        law = nominal + mean.to(nominal), deviation.abs().to(nominal)
        return torch.distributions.Normal(*law, validate_args=False)  # of NaN comes NaN, as from f + g

    def get_extra_state(self) -> dict[str, Any]:
        """Encoding, outputs and scales: what the learner's inputs and outputs mean."""
        made = describe(self)
        names = "encode", "outputs", "action_scale", "output_scale"
        return {"made_with": {**made, "arguments": {name: made["arguments"][name] for name in names}}}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """They were compared before anything was loaded."""

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """See ``torch.nn.Module``; all or nothing.

        Raises:
            StateMismatchError: the state is one of another encoding, learner or model. Nothing was changed.
        """
        if strict:
            check_state(self, state_dict)
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def _check_width(self, name: str, increment: Tensor) -> None:
        """ShapeError where the entries are not those that the learner corrects."""
        least = self.learner.out_features if self.outputs is None else max(self.outputs) + 1
        n_s = increment.shape[-1] if increment.dim() else 0
        if n_s < least or (self.outputs is None and n_s > least):
            expected = f"(*batch, {least})" if self.outputs is None else f"(*batch, {least} or more)"
            hint = "the learner corrects all of it, or those that outputs= names"
            raise ShapeError(name, expected, increment.shape, hint)

    def _gather(self, increment: Tensor) -> Tensor:
        return increment if self.outputs is None else increment[..., self.outputs]

    def _scatter(self, values: Tensor, like: Tensor) -> Tensor:
        if self.outputs is None:
            return values.to(like.dtype)
        out = torch.zeros_like(like)
        index = torch.tensor(self.outputs, device=like.device)
        return out.index_copy(-1, index, values.to(like.dtype))


def kinematic_and_enhanced(
    model: KinematicModel | EnhancedModel,
) -> tuple[KinematicModel, EnhancedModel | None]:
    """f, and f + g around it; None: nothing is learned."""
    return (model.model, model) if isinstance(model, EnhancedModel) else (model, None)


def _checked_action(action: Any) -> Tensor:
    """Values have the action's dtype: of integers f + g would be rounded to such."""
    if not isinstance(action, Tensor) or not action.is_floating_point():
        kind = str(action.dtype) if isinstance(action, Tensor) else type(action).__name__
        valid = "a tensor of floating-point numbers: torch.as_tensor(action, dtype=torch.float64)"
        raise ParameterError("action", kind, valid)
    return action


def _check_arguments(model: Any, learner: Any, encode: Any, outputs: Any, jacobian: Any) -> None:
    checks = (
        ("model", model, callable(model), "a callable f(state, action) -> increment"),
        ("learner", learner, isinstance(learner, ResidualLearner), "a ResidualLearner"),
        ("encode", encode, encode is None or callable(encode), "a callable of the state, or None"),
        (
            "jacobian", jacobian, jacobian in (None, "finite-difference") or callable(jacobian),
            "a callable of state and action, 'finite-difference', or None",
        ),
    )  # fmt: skip
    for name, value, good, valid in checks:
        if not good:
            raise ParameterError(name, value, valid)
    if outputs is not None:
        indices = list(outputs) if isinstance(outputs, Iterable) else []  # refused, since a learner has one
        good = all(type(i) is int and i >= 0 for i in indices) and len(set(indices)) == len(indices)
        if not good or len(indices) != learner.out_features:
            valid = f"{learner.out_features} different indices, one for each output of the learner"
            raise ParameterError("outputs", outputs, valid)


def save(learner: ResidualLearner | EnhancedModel, path: str | os.PathLike) -> None:
    """Write how a learner was made and all that it has learned; of an enhanced model everything but f.

    The file is a zip archive of a JSON header and arrays. It appears whole or not at all.

    Raises:
        NoStateError: it holds something that is not a plain value, such as a function for ``encode`` (save
            its ``learner``) or another library's objects; the message names it.
        OutputError: the file cannot be written.
    """
    if not isinstance(learner, ResidualLearner | EnhancedModel):
        raise NoStateError(type(learner).__name__, "it is neither a ResidualLearner nor an EnhancedModel")
    described = describe(learner)
    with (learner.learner if isinstance(learner, EnhancedModel) else learner).lock:
        state = learner.state_dict()
        if isinstance(learner, EnhancedModel):
            described["arguments"].pop("model")
            state = {name: one for name, one in state.items() if not name.startswith("model.")}
        state = copy.deepcopy(state)  # of one moment, whoever learns meanwhile
    write(path, described, state)


def load(
    path: str | os.PathLike, *, model: Callable[[Any, Any], Any] | None = None, classes: Iterable[type] = ()
) -> Any:
    """What :func:`save` wrote, made again and in the state it had. Nothing in the file is ever run.

    Args:
        model: f, if an enhanced model was saved.
        classes: learners, kernels or parts of your own that occur in the file.

    Returns:
        The ResidualLearner or EnhancedModel.

    Raises:
        FileFormatError: there is no such file, :func:`save` has not written it, or it is damaged.
        StateMismatchError: state and description do not go together.
        ParameterError: a class is not known, or f is missing (or given for a learner).
    """
    described, state = read(path)
    known = known_classes(classes) | {"GraspState": GraspState}
    enhanced = isinstance(described, dict) and described.get("class") == "EnhancedModel"
    if enhanced != (model is not None):
        valid = "None: the file holds a learner alone"
        if enhanced:
            valid = "the model f, as in load(path, model=f): the file holds f + g without f"
        raise ParameterError("model", model, valid)
    if model is not None:
        known["EnhancedModel"] = lambda **arguments: EnhancedModel(model, **arguments)
        if isinstance(model, nn.Module):
            state |= {f"model.{name}": one for name, one in model.state_dict().items()}
    made = rebuild(path, described, state, known)
    if not isinstance(made, ResidualLearner | EnhancedModel):
        raise FileFormatError(path, f"holds a {type(made).__name__}, no learner")
    return made
