"""The geometry of an arm as ONNX nodes: what `rejoint.arms` computes, for one posture (n,)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from onnx import TensorProto, helper

from rejoint.arms import Arm, Array
from rejoint.arms.inverse import DAMPING, MOST_STEP, REST_GAIN, ROUNDS, TOLERANCE
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import cross_matrix
from rejoint.runs.exporting.tensors import Graph, Tensor, solved, where


class LinkFrames(NamedTuple):
    """An arm in a posture."""

    axes: Tensor
    """(n, 3)"""
    origins: Tensor
    """(n, 3) [m] of the joint frames"""
    centres: Tensor
    """(n, 3) [m] of mass of the links"""
    tcp: Tensor
    """(3,) [m]"""
    transpose: Tensor
    """(n, 3) [m/rad] of the Jacobian"""


def pose(graph: Graph, arm: Arm, q: Tensor) -> LinkFrames:
    """Compute where everything is at the posture ``q`` (n,) [rad]."""
    sine, cosine = q.apply("Sin"), q.apply("Cos")
    frame = graph.constant(np.eye(4)[:3])
    axes, origins, centres = [], [], []
    for j in range(arm.joints):
        cross = cross_matrix(arm.axis[j])
        square = cross @ cross  # Rodrigues: R = I + sin q K + (1 - cos q) K^2
        still, turned, level = (arm.offset[j] @ _framed(part) for part in (np.eye(3) + square, cross, -square))
        still[:, 3] = arm.offset[j][:, 3]
        frame = frame @ (graph.constant(turned) * sine.pick(j) + graph.constant(level) * cosine.pick(j) + still)
        axes.append((frame @ np.append(arm.axis[j], 0.0)).shaped(1, 3))
        origins.append(frame.pick(3, 1).shaped(1, 3))
        centres.append((frame @ np.append(arm.com[j], 1.0)).shaped(1, 3))
    tcp = frame @ arm.tip[:, 3]
    joints, places = graph.joined(axes), graph.joined(origins)
    return LinkFrames(joints, places, graph.joined(centres), tcp, joints.cross(tcp - places))


def _framed(rotation: Array) -> Array:
    frame = np.zeros((4, 4))
    frame[:3, :3] = rotation
    return frame


def dls(transpose: Tensor, error: Tensor, damping: Tensor | float = DAMPING) -> Tensor:
    """Return the damped least-squares step (n,) [rad] for an ``error`` (3,) [m]."""
    ridge = transpose.graph.tensor(damping) * damping * np.eye(3)
    return transpose @ solved(transpose.T @ transpose + ridge, error)


def clip_norm(step: Tensor, limit: ArrayLike) -> Tensor:
    """Return a step (n,), scaled down so that no entry is larger than the limit."""
    return step * (step.graph.tensor(limit) / step.largest().at_least(1e-12)).at_most(1.0)


def gravity_torque(graph: Graph, arm: Arm, seen: LinkFrames) -> Tensor:
    """Return the torques (n,) [N m] that hold the arm against gravity."""
    hanging = np.triu(np.ones((arm.joints, arm.joints)))
    mass = (hanging @ arm.mass)[:, None]
    moment = graph.constant(hanging) @ (seen.centres * arm.mass[:, None]) - seen.origins * mass
    return seen.axes.cross(moment) @ -GRAVITY


def solve_position(graph: Graph, arm: Arm, target: Tensor, start: Tensor, wanted: Tensor) -> Tensor:
    """Return the posture (n,) [rad] of a ``target`` (3,) [m], searched from ``start``, or that where not ``wanted``."""
    body = Graph(constants=graph.constants, scope="ik.")
    q = Tensor(body, "ik.posture")
    seen = pose(body, arm, q)
    error = target_in(body, target) - seen.tcp
    found = error.largest() < TOLERANCE
    damping = (error.norm() + 1e-4).at_most(DAMPING)
    pull = (body.constant(arm.rest) - q) * REST_GAIN
    back = dls(seen.transpose, pull @ seen.transpose, 1e-6)
    step = clip_norm(dls(seen.transpose, error, damping) + pull - back, MOST_STEP)
    following = where(found, q, (q + step).between(arm.lower, arm.upper))
    again = ~found
    tensor = helper.make_tensor_value_info
    inner = helper.make_graph(
        [*body.nodes], "inverse_kinematics",
        [tensor("round", TensorProto.INT64, []), tensor("go_on", TensorProto.BOOL, []),
         tensor(q.name, TensorProto.DOUBLE, [arm.joints])],
        [tensor(again.name, TensorProto.BOOL, []), tensor(following.name, TensorProto.DOUBLE, [arm.joints])],
    )  # fmt: skip
    rounds = graph.constant(ROUNDS, np.int64)
    return graph.node("Loop", rounds, wanted, start.between(arm.lower, arm.upper), body=inner)


def target_in(body: Graph, outer: Tensor) -> Tensor:
    """Return a tensor of the graph around a body, as that names it."""
    return Tensor(body, outer.name)
