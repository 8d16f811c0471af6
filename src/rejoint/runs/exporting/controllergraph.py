"""A controller as one ONNX graph: observation, network, command law, and its memory as a tensor.

What `PolicyController` and `FeedforwardController` compute in a control cycle is written out here once more, for one
arm and in float64, since nothing else can run in a program that knows only ONNX. A test compares the two over recorded
runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper

from rejoint.arms import Arm
from rejoint.arms.size import heaviest_load, moves_tool, unloaded_joints
from rejoint.control.contract import INPUT, OUTPUT
from rejoint.control.feedforward import SPEED_SMOOTHING
from rejoint.control.law import PROJECTION_DAMPING
from rejoint.control.observation import (
    HISTORY,
    LIMIT,
    LONGEST_PERIOD,
    LONGEST_WAIT,
    MIDDLE_PERIOD,
    PERIOD_SMOOTHING,
    residual_factors,
)
from rejoint.control.pace import LONGEST_PERIOD as PACE_LONGEST
from rejoint.control.residual import CommandLaw, working_envelope
from rejoint.runs.exporting.armgraph import clip_norm, dls, gravity_torque, pose, solve_position
from rejoint.runs.exporting.tensors import Graph, Tensor, where

OPSET, IR_VERSION = 18, 8
"""ONNX operators of December 2022, and a form that ONNX Runtime 1.14 and newer read"""

GAP = 0.5
"""[s] after which the controller begins anew (as `rejoint.control.runstate` has it)"""


def memory_slots(joints: int) -> dict[str, int]:
    """Return names and sizes of what is remembered from cycle to cycle, in order; zeros begin anew."""
    n = joints
    return {
        "sent": n, "begun": 1, "target": 3, "since_target": 1, "goal": n, "correction": n, "speed": n, "position": n,
        "velocity": HISTORY * n, "action": HISTORY * n, "mean_period": 1,
    }  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Design:
    """What is written as a graph."""

    arm: Arm
    law: CommandLaw
    """with the anchor ``goal``"""
    network: bytes | None
    """of the policy, an ONNX file; None: the law alone, which is then the feed-forward controller"""
    name: str = "policy"
    """of the controller"""
    damping: tuple[float, ...] = ()
    """[N m s/rad] of the servos, () where it is not known"""
    periods: tuple[float, float] = (0.018, 0.055)
    """[s] shortest and longest control period that it is for"""
    gains: str = ""
    """in words, of the servos' own loops that it was trained for; empty where they are not known"""
    instead: str = ""
    """a sentence, where the run recommends another controller, which cannot be written; else empty"""


def controller_graph(design: Design) -> onnx.ModelProto:
    """Build the graph of one control cycle.

    Inputs, all float32: ``joint_pos`` (1, n) [rad], ``target`` (1, 3) [m], ``period`` (1, 1) [s] since the last cycle,
    ``state_in`` (1, s). Outputs: ``joint_command`` (1, n) [rad], ``state_out`` (1, s).
    """
    n, graph = design.arm.joints, Graph()
    slots = memory_slots(n)
    cycle = _CycleGraph(graph, design)
    old = _split(_read(graph, "state_in", sum(slots.values())), slots)
    period = _read(graph, "period", 1).pick(0)
    command, memory = cycle.run(_read(graph, "joint_pos", n), _read(graph, "target", 3), period, old)
    _write(graph, "joint_command", command)
    _write(graph, "state_out", graph.joined([memory[name].shaped(size) for name, size in slots.items()]))
    tensor, size = helper.make_tensor_value_info, sum(slots.values())
    inputs = [("joint_pos", n), ("target", 3), ("period", 1), ("state_in", size)]
    outputs = [("joint_command", n), ("state_out", size)]
    network = [] if design.network is None else list(onnx.load_from_string(design.network).graph.initializer)
    whole = helper.make_graph(
        graph.nodes, "controller",
        [tensor(name, TensorProto.FLOAT, [1, length]) for name, length in inputs],
        [tensor(name, TensorProto.FLOAT, [1, length]) for name, length in outputs],
        [*graph.initializers(), *network],
    )  # fmt: skip
    model = helper.make_model(
        whole, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="rejoint"
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def _read(graph: Graph, name: str, size: int) -> Tensor:
    return graph.node("Cast", Tensor(graph, name).shaped(size), to=TensorProto.DOUBLE)


def _write(graph: Graph, name: str, value: Tensor) -> None:
    single = graph.node("Cast", value, to=TensorProto.FLOAT)
    shape = graph.constant([1, -1], np.int64)
    graph.nodes.append(helper.make_node("Reshape", [single.name, shape.name], [name]))


def _split(state: Tensor, slots: dict[str, int]) -> dict[str, Tensor]:
    found, place = {}, 0
    for name, size in slots.items():
        found[name] = state.pick(place) if size == 1 else state.part(place, place + size)
        place += size
    return found


@dataclass(frozen=True, eq=False)
class _CycleGraph:
    """One control cycle."""

    graph: Graph
    design: Design

    def run(
        self, position: Tensor, target: Tensor, period: Tensor, old: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the command (n,) [rad], and what is remembered."""
        graph, arm, law = self.graph, self.design.arm, self.design.law
        begun = old["begun"] > 0.5
        sent = where(begun, old["sent"], position)
        elapsed = where(begun, period.at_least(0.0), 0.0)
        fresh = ~begun | ((target - old["target"]).largest() > 0.0) | (elapsed > GAP)
        since = where(fresh, 0.0, old["since_target"] + elapsed)
        goal = where(fresh, solve_position(graph, arm, target, sent, fresh), old["goal"])
        there = pose(graph, arm, goal)
        idle = old["correction"] - dls(there.transpose, old["correction"] @ there.transpose, PROJECTION_DAMPING)
        raised = goal + gravity_torque(graph, arm, there) / np.array(law.stiffness)

        seen = self._view(position, target)
        known = self._measured(position, elapsed, fresh, old)
        action = self._act(position, sent, seen, since, known)
        push, extra = self._weigh(seen, since, action)
        speed, learned = self._integrate(
            (position - where(begun, old["position"], position), elapsed), old["speed"],
            old["correction"] - where(fresh, idle, 0.0), push, extra,
        )  # fmt: skip
        command = (raised + learned).between(arm.lower, arm.upper)
        command = command.between(*working_envelope(arm, law.envelope_margin))
        actions = graph.joined([action, known["action"].part(0, (HISTORY - 1) * arm.joints)])
        return command, known | {
            "sent": command, "begun": graph.constant([1.0]), "target": target, "since_target": since, "goal": goal,
            "correction": learned, "speed": speed, "position": position, "action": actions,
        }  # fmt: skip

    def _view(self, position: Tensor, target: Tensor) -> _TargetView:
        there = pose(self.graph, self.design.arm, position)
        error = target - there.tcp
        return _TargetView(dls(there.transpose, error), error, error.norm())

    def _measured(self, position: Tensor, elapsed: Tensor, fresh: Tensor, old: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return velocities, mean period and past actions, as the observation has them."""
        n, news = self.design.arm.joints, (elapsed > 0.0) & ~fresh
        velocity, action = (where(fresh, 0.0, old[name]) for name in ("velocity", "action"))
        latest = (position - old["position"]) / where(news, elapsed, 1.0)
        shifted = self.graph.joined([latest, velocity.part(0, (HISTORY - 1) * n)])
        mean = where(old["begun"] > 0.5, old["mean_period"], MIDDLE_PERIOD)
        changed = mean + (elapsed.at_most(LONGEST_PERIOD) - mean) * PERIOD_SMOOTHING
        return {
            "velocity": where(news, shifted, velocity), "action": action, "mean_period": where(news, changed, mean)
        }  # fmt: skip

    def _act(
        self, position: Tensor, sent: Tensor, seen: _TargetView, since: Tensor, known: dict[str, Tensor]
    ) -> Tensor:
        """Return the action (n,) of the network for the observation of the layout ``residual``."""
        graph, n = self.graph, self.design.arm.joints
        if self.design.network is None:
            return graph.constant(np.zeros(n))
        numbers = graph.joined([
            sent - position, known["velocity"], seen.step, seen.step, seen.step, position, seen.error,
            seen.error / (seen.distance + 0.003), ((seen.distance + 0.0003).apply("Log") + 5.0).shaped(1),
            (since.at_most(LONGEST_WAIT) - 0.5).shaped(1), (known["mean_period"] - MIDDLE_PERIOD).shaped(1),
            known["action"],
        ]) * residual_factors(n)  # fmt: skip
        size, near = 11 * n + 9, ((2 + HISTORY) * n, (4 + HISTORY) * n)
        numbers = graph.joined([
            numbers.part(0, near[0]), numbers.part(*near).apply("Tanh"), numbers.part(near[1], size)
        ])  # fmt: skip
        observation = graph.node("Cast", numbers.between(-LIMIT, LIMIT).shaped(1, size), to=TensorProto.FLOAT)
        return graph.node("Cast", self._network(observation).shaped(n), to=TensorProto.DOUBLE)

    def _network(self, observation: Tensor) -> Tensor:
        """Append the layers of the policy's network; their weights go into the file as they are."""
        assert self.design.network is not None  # noqa: S101 - the caller has looked
        nodes = onnx.load_from_string(self.design.network).graph.node
        produced = {name for node in nodes for name in node.output}

        def named(name: str) -> str:
            return observation.name if name == INPUT else f"network.{name}"

        for node in nodes:
            copy = NodeProto()
            copy.CopyFrom(node)
            copy.input[:] = [named(name) if name in produced or name == INPUT else name for name in node.input]
            copy.output[:] = [named(name) for name in node.output]
            self.graph.nodes.append(copy)
        return Tensor(self.graph, named(OUTPUT))

    def _weigh(self, seen: _TargetView, since: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return what of step and action is integrated, (n,) [rad] each (`rejoint.control.residual.Commander`)."""
        arm, law = self.design.arm, self.design.law
        load, largest = heaviest_load(arm), seen.step.largest()
        spared = 1.0 - 1.0 / (1.0 + law.load_penalty * load / max(load.max(), 1e-9))
        faded = seen.distance / (seen.distance + law.learning.fade)
        ratio = seen.distance / law.load_penalty_distance
        close = self.graph.tensor(1.0) / (ratio * ratio + 1.0)
        push = clip_norm(seen.step, law.step_limit) * faded * (self.graph.tensor(1.0) - close * spared)
        authority = (largest * law.authority_slope + law.authority_floor).at_most(law.authority_limit)
        extra = action.between(-1.0, 1.0) * authority * moves_tool(arm).astype(float)
        if law.decay_start <= 0.0:
            return push, extra
        late = self.graph.node(
            "Pow", self.graph.tensor(law.decay_start) / since.at_least(law.decay_start), law.decay_power
        )
        near = (largest / law.decay_step).at_most(1.0)
        decayed = late + (self.graph.tensor(1.0) - late) * near * near
        factor = where(self.graph.constant(unloaded_joints(arm), np.bool_), decayed, 1.0)
        return push * factor, extra * factor

    def _integrate(
        self, moved: tuple[Tensor, Tensor], speed: Tensor, learned: Tensor, push: Tensor, extra: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return speeds and corrections, (n,) each (`rejoint.control.compiled.integrate`)."""
        gains, (way, span) = self.design.law.learning, moved
        elapsed = span.at_most(PACE_LONGEST)
        newest = where(elapsed > 0.0, way / where(elapsed > 0.0, elapsed, 1.0), speed)
        now = newest * SPEED_SMOOTHING + speed * (1.0 - SPEED_SMOOTHING)
        added = push * (elapsed * gains.rate)
        on_its_way = (now.apply("Abs") > gains.moving) & ((now * added) > 0.0)
        learned = learned + where(on_its_way, 0.0, added) + extra
        return now, learned.between(-gains.learned_limit, gains.learned_limit)


@dataclass(frozen=True, eq=False)
class _TargetView:
    """The target from where the arm is: step (n,) [rad] towards it, error (3,) and distance () [m]."""

    step: Tensor
    error: Tensor
    distance: Tensor
