"""A controller as one ONNX graph, written for PyTorch; its memory is a tensor."""

from __future__ import annotations

import warnings
from typing import Any, TypeVar, cast

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from rejoint.arms import Arm
from rejoint.arms.kinematics import DAMPING, GRAVITY, MOST_STEP, REST_GAIN, ROUNDS, TOLERANCE, joint_terms
from rejoint.arms.workspace import unloaded_joints
from rejoint.control.controllers.classical import LONGEST_PERIOD as PACE_LONGEST
from rejoint.control.controllers.classical import PROJECTION_DAMPING
from rejoint.control.controllers.feedforward import (
    CALMER,
    EARLY,
    HELD_BACK,
    LEAST_PUSH,
    SPEED_SMOOTHING,
    TAKEN_BACK,
    Commander,
    CommandLaw,
)
from rejoint.control.controllers.observation import (
    HISTORY,
    LIMIT,
    LONGEST_PERIOD,
    LONGEST_WAIT,
    MIDDLE_PERIOD,
    PERIOD_SMOOTHING,
    layout_factors,
)
from rejoint.training.train import to_onnx

F = TypeVar("F")

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


def _tensor(value: Any) -> Tensor:  # noqa: ANN401 - whatever NumPy takes
    return torch.as_tensor(np.array(value, dtype=float))


def _arm_tensors(arm: Arm) -> list[Tensor]:
    """Constants of `_pose` and `_search`.

    Joint frames (n, 4, 4): constant, sine and cosine part; axes (n, 3), centres of mass (n, 4), tip (4,), rest posture,
    limits (n,).
    """
    parts = np.moveaxis(joint_terms(arm).reshape(-1, 4, 4, 3), -1, 0)
    com = np.column_stack([arm.com, np.ones(arm.joints)])
    return [*map(_tensor, (*parts, arm.axis, com, arm.tip[:, 3], arm.rest, arm.lower, arm.upper))]


def _scripted(function: F) -> F:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return cast("F", torch.jit.script(function))


@_scripted
def _pose(arm: list[Tensor], q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Joint axes, origins [m], centres of mass [m] (n, 3) each, TCP (3,) [m], Jacobian transposed (n, 3)."""
    still, sine, cosine, axis, com, tip = arm[0], arm[1], arm[2], arm[3], arm[4], arm[5]
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
    rest, lower, upper = arm[6], arm[7], arm[8]
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


class _CycleGraph(nn.Module):
    def __init__(self, arm: Arm, law: CommandLaw, network: bytes | None) -> None:
        super().__init__()
        self.network, self.law, self.n = network, law, arm.joints
        self.arm = _arm_tensors(arm)
        self.limits = self.arm[-2:]
        self.hanging, self.mass = _tensor(np.triu(np.ones((self.n, self.n)))), _tensor(arm.mass[:, None])
        self.stiffness, self.gravity = _tensor(law.stiffness), _tensor(-GRAVITY)
        self.factors, self.unloaded = _tensor(layout_factors("residual", self.n)), _tensor(unloaded_joints(arm))
        self.commander = Commander(arm, law)
        self.moves, self.spared = _tensor(self.commander.moves), _tensor(self.commander.spared)

    def forward(self, joint_pos: Tensor, target: Tensor, period: Tensor, state_in: Tensor) -> tuple[Tensor, Tensor]:
        """Command and memory."""
        arm, law, slots = self.arm, self.law, memory_slots(self.n)
        position, target, state = (one.double().reshape(-1) for one in (joint_pos, target, state_in))
        old = dict(zip(slots, torch.split(state, list(slots.values())), strict=True))
        begun = old["begun"] > 0.5
        old |= {name: torch.where(begun, old[name], position) for name in ("sent", "asked", "position")}
        sent = old["sent"]
        elapsed = torch.where(begun, period.double().reshape(1).clamp(min=0.0), 0.0)
        changed = (target - old["target"]).abs().max() > 0.0
        fresh = ~begun | changed | (elapsed > GAP)
        since = torch.where(fresh, 0.0, old["since_target"] + elapsed)
        rounds = torch.where(fresh, ROUNDS, 0).squeeze(0)
        found = _search(arm, target, sent, rounds, (TOLERANCE, DAMPING, REST_GAIN, MOST_STEP))
        goal = torch.where(fresh, found, old["goal"])
        axes, origins, centres, _, transpose = _pose(arm, goal)
        ridge = torch.full((), PROJECTION_DAMPING, dtype=torch.float64)
        idle = old["correction"] - _dls(transpose, old["correction"] @ transpose, ridge)
        moment = self.hanging @ (centres * self.mass) - origins * (self.hanging @ self.mass)
        raised = goal + (torch.linalg.cross(axes, moment) @ self.gravity) / self.stiffness

        _, _, _, tcp, transpose = _pose(arm, position)
        error = target - tcp
        distance = (error * error).sum().sqrt()
        step = _dls(transpose, error, torch.full((), DAMPING, dtype=torch.float64))
        known = self._measured(position, elapsed, fresh, old)
        action = self._act(position, sent, (step, error, distance), since, known)
        push, extra = self._weigh(step, distance, since, action)

        gains, span = law.learning, elapsed.clamp(max=PACE_LONGEST)
        way = position - old["position"]
        loosened, sticking = self._loosen(step, (distance, since), span, way, fresh, old)
        extra = extra + loosened
        if self.network is None:
            short = old["asked"] - sent
            held = short.abs() > HELD_BACK
            push, extra = (torch.where(held & (short * one > 0.0), 0.0, one) for one in (push, extra))
        newest = torch.where(span > 0.0, way / torch.where(span > 0.0, span, 1.0), old["speed"])
        speed = newest * SPEED_SMOOTHING + old["speed"] * (1.0 - SPEED_SMOOTHING)
        near, far = gains.far
        far_off = ((distance - near) / (far - near)).clamp(0.0, 1.0)
        forgotten = far_off * (1.0 - torch.exp(-gains.forgetting * span))
        learned = old["correction"] - idle * torch.where(fresh, far_off + (1.0 - far_off) * forgotten, forgotten)
        added = push * (span * gains.rate)
        on_its_way = (speed.abs() > gains.moving) & (speed * added > 0.0)
        learned = (learned + torch.where(on_its_way, 0.0, added) + extra).clamp(
            -gains.learned_limit, gains.learned_limit
        )
        margin = law.envelope_margin
        command = torch.clamp(torch.clamp(raised + learned, goal - margin, goal + margin), *self.limits)
        actions = torch.cat([action, known["action"][: (HISTORY - 1) * self.n]])
        memory = known | sticking | {"begun": torch.ones(1, dtype=torch.float64), "since_target": since}
        memory |= {"sent": command, "asked": command, "target": target, "goal": goal, "correction": learned}
        memory |= {"speed": speed, "position": position, "action": actions}
        state = torch.cat([memory[name] for name in slots])
        return command.float().reshape(1, -1), state.float().reshape(1, -1)

    def _loosen(
        self,
        step: Tensor,
        seen: tuple[Tensor, Tensor],
        span: Tensor,
        way: Tensor,
        fresh: Tensor,
        old: dict[str, Tensor],
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Addition (n,) [rad] for stuck joints, and its memory."""
        eager, came = torch.where(fresh, 1.0, old["eager"]), torch.where(fresh, 0.0, old["came"])
        share, (distance, since) = step / step.abs().max().clamp(min=1e-9), seen
        sticks, loose = way == 0.0, way * old["pushed"] > 0.0
        speed = self.commander.loosen * (distance / self.commander.gentle + since / EARLY).clamp(LEAST_PUSH, 1.0)
        added = torch.where(sticks & (distance > self.commander.close), span * speed * eager * share, 0.0)
        taken, back = (torch.where(loose, one, 0.0) for one in (TAKEN_BACK * old["pushed"], torch.sign(old["pushed"])))
        return added - taken, {
            "pushed": torch.where(sticks, old["pushed"] + added, 0.0),
            "eager": torch.where(back * came < 0.0, CALMER * eager, eager),
            "came": torch.where(loose, back, came),
        }

    def _measured(self, position: Tensor, elapsed: Tensor, fresh: Tensor, old: dict[str, Tensor]) -> dict[str, Tensor]:
        news = (elapsed > 0.0) & ~fresh
        velocity, action = (torch.where(fresh, 0.0, old[name]) for name in ("velocity", "action"))
        latest = (position - old["position"]) / torch.where(news, elapsed, 1.0)
        shifted = torch.cat([latest, velocity[: (HISTORY - 1) * self.n]])
        mean = torch.where(old["begun"] > 0.5, old["mean_period"], MIDDLE_PERIOD)
        changed = mean + (elapsed.clamp(max=LONGEST_PERIOD) - mean) * PERIOD_SMOOTHING
        return {
            "velocity": torch.where(news, shifted, velocity),
            "action": action,
            "mean_period": torch.where(news, changed, mean),
        }

    def _act(
        self,
        position: Tensor,
        sent: Tensor,
        seen: tuple[Tensor, Tensor, Tensor],
        since: Tensor,
        known: dict[str, Tensor],
    ) -> Tensor:
        """Network's action (n,) for the observation layout ``residual``."""
        if self.network is None:
            return torch.zeros(self.n, dtype=torch.float64)
        step, error, distance = seen
        numbers = torch.cat([
            sent - position, known["velocity"], step, step, step, position, error, error / (distance + 0.003),
            (torch.log(distance + 0.0003) + 5.0).reshape(1), since.clamp(max=LONGEST_WAIT) - 0.5,
            known["mean_period"] - MIDDLE_PERIOD, known["action"],
        ]) * self.factors  # fmt: skip
        first, last = (2 + HISTORY) * self.n, (4 + HISTORY) * self.n
        numbers = torch.cat([numbers[:first], torch.tanh(numbers[first:last]), numbers[last:]])
        return _answer(self.network, numbers.clamp(-LIMIT, LIMIT).float().reshape(1, -1)).reshape(-1).double()

    def _weigh(self, step: Tensor, distance: Tensor, since: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Integrated parts of step and action (n,) [rad] (`rejoint.control.controllers.feedforward.Commander`)."""
        law, largest, ratio = self.law, step.abs().max(), distance / self.law.load_penalty_distance
        push = _clip_norm(step, float(law.step_limit)) * (distance / (distance + law.learning.fade))
        push = push * (1.0 - self.spared / (ratio * ratio + 1.0))
        authority = (largest * law.authority_slope + law.authority_floor).clamp(max=law.authority_limit)
        extra = action.clamp(-1.0, 1.0) * authority * self.moves
        if law.decay_start <= 0.0:
            return push, extra
        late = (law.decay_start / since.clamp(min=law.decay_start)) ** law.decay_power
        near = (largest / law.decay_step).clamp(max=1.0)
        factor = torch.where(self.unloaded > 0.0, late + (1.0 - late) * near * near, 1.0)
        return push * factor, extra * factor


def _answer(network: bytes, values: Tensor) -> Tensor:
    graph = onnx.load_from_string(network).graph
    held = {one.name: torch.as_tensor(numpy_helper.to_array(one).copy()) for one in graph.initializer}
    for node in graph.node:  # of the operators that a policy may have
        more = [held[name] for name in node.input[1:]]
        match node.op_type:
            case "Gemm":
                values = functional.linear(values, *more)
            case "Elu":
                values = functional.elu(values, node.attribute[0].f)
            case "Tanh":
                values = torch.tanh(values)
            case "Clip":
                values = values.clamp(*(float(one) for one in more))
    return values
