"""A controller as one ONNX graph: PyTorch traces its law; its memory is a tensor."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from rejoint.arms import Arm
from rejoint.arms.kinematics import DAMPING, GRAVITY, MOST_STEP, REST_GAIN, ROUNDS, TOLERANCE, joint_terms
from rejoint.control.controllers.classical import PROJECTION_DAMPING, STEP_LIMIT, DlsStep
from rejoint.control.controllers.feedforward import Commander, CommandLaw
from rejoint.control.controllers.observation import HISTORY, MIDDLE_PERIOD, Observer, View
from rejoint.control.robot import ControlInput, JointState
from rejoint.training.train import to_onnx

GAP = 0.5
"""[s] after which the controller restarts (as in `rejoint.control.loop`)"""


def memory_slots(joints: int) -> dict[str, int]:
    """Names and sizes of the memory, in order; zeros restart it."""
    n = joints
    return {
        "sent": n, "begun": 1, "target": 3, "since_target": 1, "goal": n, "correction": n, "speed": n, "position": n,
        "velocity": HISTORY * n, "action": HISTORY * n, "mean_period": 1, "pushed": n, "eager": n, "came": n,
        "asked": n,
    }  # fmt: skip


def controller_graph(arm: Arm, law: CommandLaw, network: bytes | None) -> onnx.ModelProto:
    """Build the graph of one control cycle of a ``law``, perhaps with a policy's ``network``, all float32.

    Inputs ``joint_pos`` (1, n) [rad], ``target`` (1, 3) [m], ``period`` (1, 1) [s], ``state_in`` (1, s); outputs
    ``joint_command`` (1, n) [rad], ``state_out`` (1, s).
    """
    n, size = arm.joints, sum(memory_slots(arm.joints).values())
    inputs = {"joint_pos": n, "target": 3, "period": 1, "state_in": size}
    model = to_onnx(_CycleGraph(arm, law, network), inputs, ["joint_command", "state_out"])
    for output, length in zip(model.graph.output, (n, size), strict=True):
        output.type.tensor_type.shape.dim[1].dim_value = length  # what a loop leaves has no known size
    onnx.checker.check_model(model, full_check=True)
    return model


def _tensor(value: Any) -> Any:  # noqa: ANN401 - whatever NumPy takes
    return torch.as_tensor(np.array(value, dtype=float))


def _scripted(function: Callable[..., Any]) -> Any:  # noqa: ANN401
    with warnings.catch_warnings(action="ignore"):
        return torch.jit.script(function)


@_scripted
def _pose(arm: list[Tensor], q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Joint axes, origins [m], centres of mass [m] (n, 3) each, TCP (3,) [m], Jacobian transposed (n, 3)."""
    still, sine, cosine, axis, com, tip = arm[:6]
    frame, index = torch.eye(4, dtype=torch.float64)[:3], torch.arange(q.shape[0])
    frames = torch.zeros((q.shape[0], 3, 4), dtype=torch.float64)
    for j in range(q.shape[0]):
        frame = frame @ (still[j] + sine[j] * torch.sin(q[j]) + cosine[j] * torch.cos(q[j]))
        frames = torch.where((index == j).reshape(-1, 1, 1), frame, frames)
    axes, origins = (frames[:, :, :3] @ axis.unsqueeze(2)).squeeze(2), frames[:, :, 3]
    centres, tcp = (frames @ com.unsqueeze(2)).squeeze(2), frame @ tip
    return axes, origins, centres, tcp, torch.linalg.cross(axes, tcp - origins)


@_scripted
def _dls(transpose: Tensor, error: Tensor, damping: Tensor) -> Tensor:
    """Damped least-squares step (n,) [rad] for ``error`` (3,) [m]."""
    gram = transpose.t() @ transpose + damping * damping * torch.eye(3, dtype=torch.float64)
    # by its cofactors: ONNX has no operator to solve
    cofactors = torch.linalg.cross(torch.roll(gram, -1, 0), torch.roll(gram, -2, 0))
    return transpose @ ((error @ cofactors) / torch.sum(gram[0] * cofactors[0]))


@_scripted
def _clip_norm(step: Tensor, limit: float) -> Tensor:
    """Step (n,), its largest entry scaled to ``limit``."""
    return step * torch.clamp(limit / torch.clamp(torch.max(torch.abs(step)), min=1e-12), max=1.0)


@_scripted
def _search(
    arm: list[Tensor], target: Tensor, q: Tensor, rounds: Tensor, settings: tuple[float, float, float, float]
) -> Tensor:
    """Posture (n,) [rad] of a ``target`` (3,) [m] after ``rounds`` from ``q``."""
    tolerance, most_damping, rest_gain, most_step = settings
    rest, lower, upper = arm[6:]
    q = torch.clamp(q, lower, upper)
    count, left = 0, int(rounds)
    while count < left:
        _, _, _, tcp, transpose = _pose(arm, q)
        error = target - tcp
        if bool(torch.max(torch.abs(error)) < tolerance):
            left = count
        else:
            damping = torch.clamp(torch.sqrt(torch.sum(error * error)) + 1e-4, max=most_damping)
            pull = (rest - q) * rest_gain
            back = _dls(transpose, pull @ transpose, torch.full_like(damping, 1e-6))
            step = _clip_norm(_dls(transpose, error, damping) + pull - back, most_step)
            q = torch.clamp(q + step, lower, upper)
        count += 1
    return q


where: Any = torch.where  # also of what types call arrays


LAW = ("correction", "speed", "position", "pushed", "eager", "came", "asked")
"""Attributes of a law that its memory keeps"""


class _TensorLaw(Commander):
    """The law of one arm on tensors (1, n), whose goal stands."""

    xp = torch

    def __init__(self, arm: Arm, law: CommandLaw) -> None:
        super().__init__(arm, law)
        tensors: Any = map(torch.tensor, (self.moves, self.spared, self.unloaded, arm.lower, arm.upper))
        self.moves, self.spared, self.unloaded, *self._limits = tensors

    def begin(self, old: dict[str, Any], fresh: Any, distance: Any, goal: tuple[Any, Any]) -> None:  # noqa: ANN401
        """Go on from the memory; ``goal``: raised (1, n) [rad], and its Jacobian, transposed (n, 3)."""
        self._raised, self._transpose = goal
        self._pace.last = _tensor([0.0])  # so times are periods
        for name in LAW:
            setattr(self, f"_{name}", old[name])
        self._eager, self._came = where(fresh, 1.0, self._eager), where(fresh, 0.0, self._came)
        self._correction = self._correction - where(fresh, self._far(distance), 0.0) * self._unneeded()

    def memory(self) -> dict[str, Any]:
        """Return what the next cycle goes on from."""
        return {name: getattr(self, f"_{name}") for name in LAW}

    def on_the_way(self, inputs: ControlInput) -> Any:  # noqa: ANN401, ARG002
        """See `Commander`."""
        return torch.zeros(1, dtype=torch.bool)

    def _unneeded(self) -> Any:  # noqa: ANN401
        moved = self._correction[0] @ self._transpose
        return self._correction - _dls(self._transpose, moved, _tensor(PROJECTION_DAMPING))

    def _decay(self, distance: Any, elapsed: Any) -> None:  # noqa: ANN401
        kept = torch.exp(-self._gains.forgetting * elapsed)  # ONNX has no expm1
        self._correction = self._correction - self._far(distance) * (1.0 - kept) * self._unneeded()


class _TensorObserver(Observer):
    """The observer of one arm by tensors."""

    xp = torch

    def __init__(self, arm: Arm) -> None:
        super().__init__(arm, 1)
        self._factors = _tensor(self._factors)

    def begin(self, old: dict[str, Any], fresh: Any, time: Any) -> None:  # noqa: ANN401
        """Go on from the memory, ``time`` (1, 1) [s] after it."""
        begun = (where(fresh, 0.0, old[name]).reshape(1, HISTORY, -1) for name in ("velocity", "action"))
        self._velocity, self._action = begun
        self._position, self._time = old["position"], where(fresh, time, 0.0)[0]
        self._period = old["mean_period"][0]

    def memory(self) -> dict[str, Any]:
        """Return what the next cycle goes on from."""
        kept = {"velocity": self._velocity, "action": self._action, "mean_period": self._period}
        return {name: one.reshape(1, -1) for name, one in kept.items()}


class _CycleGraph(nn.Module):
    def __init__(self, arm: Arm, law: CommandLaw, network: bytes | None) -> None:
        super().__init__()
        self.network, self.n = network, arm.joints
        parts = np.moveaxis(joint_terms(arm), 1, 0)
        com = np.column_stack([arm.com, np.ones(arm.joints)])
        self.arm = [*map(_tensor, (*parts, arm.axis, com, arm.tip[:, 3], arm.rest, arm.lower, arm.upper))]
        self.hanging, self.mass = _tensor(np.triu(np.ones((self.n, self.n)))), _tensor(arm.mass[:, None])
        self.stiffness, self.gravity = _tensor(law.stiffness), _tensor(-GRAVITY)
        self.law, self.observer = _TensorLaw(arm, law), _TensorObserver(arm)

    def forward(self, joint_pos: Any, target: Any, period: Any, state_in: Any) -> tuple[Tensor, Tensor]:  # noqa: ANN401
        """Command and memory."""
        arm, law, observer, slots = self.arm, self.law, self.observer, memory_slots(self.n)
        position, target, state = (one.double() for one in (joint_pos, target, state_in))
        old: dict[str, Any] = dict(zip(slots, torch.split(state, list(slots.values()), dim=1), strict=True))
        begun = old["begun"] > 0.5
        old |= {name: where(begun, old[name], position) for name in ("sent", "asked", "position")}
        old["mean_period"] = where(begun, old["mean_period"], MIDDLE_PERIOD)
        elapsed = where(begun, period.double().clamp(min=0.0), 0.0)
        changed = (target - old["target"]).abs().max() > 0.0
        fresh = ~begun | changed | (elapsed > GAP)
        since = where(fresh, 0.0, old["since_target"] + elapsed)
        rounds = where(fresh, ROUNDS, 0).reshape(())
        found = _search(arm, target[0], old["sent"][0], rounds, (TOLERANCE, DAMPING, REST_GAIN, MOST_STEP))
        goal = where(fresh, found, old["goal"])
        axes, origins, centres, _, transpose = _pose(arm, goal[0])
        moment = self.hanging @ (centres * self.mass) - origins * (self.hanging @ self.mass)
        raised = goal + (torch.linalg.cross(axes, moment) @ self.gravity) / self.stiffness

        _, _, _, tcp, seen = _pose(arm, position[0])
        error = target[0] - tcp
        step = _dls(seen, error, _tensor(DAMPING))
        view = View(tcp[None], error[None], (error * error).sum().sqrt()[None], step[None], goal - position)
        state = JointState(time=elapsed[0], position=position, age=np.zeros(1))
        inputs = ControlInput(state=state, target=target, goal=goal, sent=old["sent"], since_target=since[0])
        observer.begin(old, fresh, elapsed)
        law.begin(old, fresh, view.distance, (raised, transpose))
        numbers: Any = observer.numbers(inputs, view)
        command: Any
        if self.network is None:
            action, clipped = _tensor(np.zeros((1, self.n))), _clip_norm(step, float(STEP_LIMIT))[None]
            command = law.integrate(inputs, DlsStep(clipped, view.error, seen), view.distance)
        else:
            action = _answer(self.network, numbers.float()).double()
            command = law.commands(inputs, view, action)
        observer.acted(action)
        own = {"begun": torch.ones_like(since), "since_target": since, "target": target, "goal": goal}
        memory = observer.memory() | law.memory() | own | {"sent": command, "asked": command}
        return command.float(), torch.cat([memory[name] for name in slots], dim=1).float()


def _answer(network: bytes, values: Any) -> Any:  # noqa: ANN401
    graph = onnx.load_from_string(network).graph
    held = {one.name: torch.as_tensor(numpy_helper.to_array(one).copy()) for one in graph.initializer}
    for node in graph.node:
        more = [held[name] for name in node.input[1:]]
        if node.op_type == "Elu":
            more = [node.attribute[0].f]
        values = _LAYERS[node.op_type](values, *more)
    return values


_LAYERS: dict[str, Any] = {"Gemm": functional.linear, "Elu": functional.elu, "Tanh": torch.tanh, "Clip": torch.clamp}
"""The operators that a policy may have"""
