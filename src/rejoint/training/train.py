"""Train a policy for an arm: ``policy.onnx``, a network with its contract in the metadata, and its curves."""

import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnx
import pyarrow as pa
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import Tensor, nn

from rejoint.arms import Arm
from rejoint.arms.inertia import bare
from rejoint.arms.workspace import length_size
from rejoint.control.controllers.catalogue import shelf_policy
from rejoint.control.controllers.observation import layout_slots
from rejoint.control.controllers.policy import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    UNSEALED,
    PolicyContract,
    encode_contract,
    law_digests,
    ort,
    probe_observations,
    seal,
)
from rejoint.control.servogains import ServoGains
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import write_parquet
from rejoint.system.errors import ContractError
from rejoint.system.files import write_bytes
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import value_type
from rejoint.system.shell import __version__
from rejoint.training.learner import CurvePoint, Learner
from rejoint.training.ranges import BroadRanges, Ranges, training_ranges
from rejoint.training.task import Preset, load_preset
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.twin import Twin

DECAY_START = 0.7
"""[s] of the law where motors cross backlash slowly; chosen: such a joint swings once"""


@value_type
class TrainingOptions:
    """Options of a training beside the recipe."""

    preset: str | Preset = "default"
    seed: int = 0
    agents: int | None = None
    """default: the preset's"""
    iterations: int | None = None
    """updates; default: the preset's"""
    snapshot_every: int | None = None
    """updates between kept policies, the untrained one first; None: none"""
    servo_gains: ServoGains | None = None
    """of the identified servos, for the contract"""
    ranges: Ranges | None = None
    """arms to train on; default: by the twin, else broad ones"""
    start: Tensor | None = None
    """weights of the actor; default: those of the generic policy with a twin, else random"""
    learner: type[Learner] = Learner
    """the algorithm; default: PPO"""

    @property
    def recipe(self) -> Preset:
        """The preset with these numbers of agents and iterations."""
        preset = load_preset(self.preset)
        sizes = {"agents": self.agents, "iterations": self.iterations}
        given: dict[str, Any] = {name: size for name, size in sizes.items() if size is not None}
        return replace(preset, ppo=replace(preset.ppo, **given), warm=preset.warm and replace(preset.warm, **given))


@value_type
class TrainingResult:
    """Result of a training."""

    policy: Path
    curves: Path
    """Parquet, one row per update, the fields of `CurvePoint`"""
    preset: str
    seed: int
    steps: int
    """transitions"""
    success_rate: float
    """at the end, with exploration noise"""
    error_mm: float
    """the same: median at the end of a target"""
    reward: float
    wall_s: float


Trainer = Callable[[Arm, Twin | None, Path, Progress, ServoGains | None], TrainingResult]
"""Trains a policy, with gains in its contract, and writes what `rejoint.logs.runfolder.RunFolder` names for it"""


def train(
    arm: Arm,
    twin: Twin | None,
    *,
    out: Path,
    options: TrainingOptions,
    on_progress: Progress = no_progress,
) -> TrainingResult:
    """Train a policy and write ``policy.onnx`` and the folder ``training`` into ``out``.

    Without a ``twin`` it uses the broad ranges alone.
    """
    recipe, files = know_stiffness(options.recipe, arm, twin), RunFolder(out)
    start = options.start if options.start is not None or twin is None else shelf_start(arm, recipe)
    if start is not None and recipe.warm is not None:
        recipe = replace(recipe, ppo=recipe.warm)
    learner = make_learner(arm, twin, recipe, options, start)
    total = recipe.ppo.iterations
    contract = policy_contract(arm, twin, recipe, options.seed, options.servo_gains)
    for done in range(total):
        if options.snapshot_every and done % options.snapshot_every == 0:
            export_policy(files.snapshot(done), learner.network, contract)
        point = learner.iterate()
        success, error = f"success {100 * point.success_rate:.0f} %", f"error {point.error_mm:.2f} mm"
        on_progress((done + 1) / total, f"{success}, {error}, reward {point.reward:.2f}")
    write_curves(files.curves, learner.curve)
    export_policy(files.policy, learner.network, contract)
    recent = learner.curve[-5:]  # chosen: the targets that end within a few updates are enough for a percent
    names = ("success_rate", "error_mm", "reward")
    return TrainingResult(
        policy=files.policy,
        curves=files.curves,
        preset=recipe.name,
        seed=options.seed,
        steps=point.step,
        wall_s=point.wall_s,
        **{name: float(np.mean([getattr(point, name) for point in recent])) for name in names},
    )


def write_curves(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write training curves as Parquet."""
    write_parquet(path, pa.Table.from_pylist([asdict(point) for point in curve]))


def make_learner(
    arm: Arm, twin: Twin | None, recipe: Preset, options: TrainingOptions, start: Tensor | None = None
) -> Learner:
    """Set up the learner."""
    ranges, agents = options.ranges or training_ranges(arm, twin), recipe.ppo.agents
    task = recipe.make(arm, ranges, agents, recipe.task, seed=options.seed)
    return options.learner(task, recipe.ppo, seed=options.seed, start=start)


def know_stiffness(recipe: Preset, arm: Arm, twin: Twin | None) -> Preset:
    """Set the servos' stiffness in a law with gravity compensation: the twin's, else the prior's.

    With possible backlash, the gains of unloaded joints also decay. All gains decrease with the length beyond a myCobot
    280's, and targets last longer.
    """
    law = recipe.task.law
    if law.anchor != "goal" or law.stiffness:
        return recipe
    stiffness = nominal_parameters(arm).stiffness if twin is None else twin.parameters.stiffness
    size = max(length_size(bare(arm)), 1.0)
    law = replace(
        law,
        stiffness=tuple(np.round(stiffness, 6).tolist()),
        learning=replace(law.learning, rate=law.learning.rate / size),
        authority_slope=law.authority_slope / size,
        authority_limit=law.authority_limit / size,
    )
    if twin is not None and BroadRanges(arm=arm).reaching(twin).backlash[1] > 0.0:
        law = replace(law, decay_start=DECAY_START)
    return replace(recipe, task=replace(recipe.task, law=law, hold_steps=round(recipe.task.hold_steps * size**0.5)))


def policy_contract(
    arm: Arm, twin: Twin | None, recipe: Preset, seed: int, servo_gains: ServoGains | None = None
) -> PolicyContract:
    """Make the contract of a policy."""
    return PolicyContract(
        arm=arm.name,
        arm_digests=law_digests(arm),
        joint_names=arm.joint_names,
        lower=tuple(arm.lower.tolist()),
        upper=tuple(arm.upper.tolist()),
        layout=recipe.task.layout,
        observation=layout_slots(recipe.task.layout, arm.joints),
        law=recipe.task.law,
        min_period=recipe.task.min_period,
        max_period=recipe.task.max_period,
        probe=(),
        twin_digest="" if twin is None else twin.digest(),
        preset=recipe.name,
        seed=seed,
        software=__version__,
        servo_gains=None if servo_gains is None else dict(servo_gains),
    )


OPSET, IR_VERSION = 18, 8
"""For ONNX Runtime 1.14 and newer"""


def export_policy(path: Path, network: nn.Sequential, contract: PolicyContract) -> PolicyContract:
    """Write ``network`` as a policy file; returns the contract with its probe.

    The exported function is the mean action clipped to [-1, 1].
    """
    model = policy_graph(network, contract.observation_size)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    answers = session.run((OUTPUT,), {INPUT: probe_observations(contract.observation_size).astype(np.float32)})[0]
    complete = replace(contract, probe=tuple(map(tuple, answers.tolist())))
    helper.set_model_props(model, {METADATA_KEY: encode_contract(complete), DIGEST_KEY: UNSEALED})
    write_bytes(path, seal(model.SerializeToString()))
    return complete


class _Bounded(nn.Sequential):
    """A network whose answers are clipped to [-1, 1]."""

    def __init__(self, network: nn.Sequential) -> None:
        super().__init__(*network)
        self.low, self.high = nn.Buffer(torch.tensor(-1.0)), nn.Buffer(torch.tensor(1.0))

    def forward(self, values: Tensor) -> Tensor:
        """Answers (B, n)."""
        found: Tensor = super().forward(values)  # type: ignore[no-untyped-call]
        return found.clamp(self.low, self.high)


def policy_graph(network: nn.Sequential, observation_size: int) -> onnx.ModelProto:
    """ONNX graph of a network for any number of observations, with a final clip to [-1, 1]."""
    batch = {name: {0: "batch"} for name in (INPUT, OUTPUT)}
    return to_onnx(_Bounded(network), {INPUT: observation_size}, [OUTPUT], dynamic_axes=batch)


def to_onnx(module: nn.Module, inputs: dict[str, int], outputs: list[str], **options: Any) -> onnx.ModelProto:  # noqa: ANN401
    """ONNX graph of ``module`` for ``inputs`` (1, size) of these names and sizes; ``options`` are PyTorch's."""
    file = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):  # its successor cannot write the loop of a search
        torch.onnx.export(
            module,
            tuple(torch.zeros(1, size) for size in inputs.values()),
            cast("Any", file),
            dynamo=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=outputs,
            **options,
        )
    model = onnx.load_from_string(file.getvalue())
    model.ir_version, model.producer_name = IR_VERSION, "rejoint"
    return model


def shelf_start(arm: Arm, recipe: Preset) -> Tensor | None:
    """Return the generic network for trainings of ``arm`` by this ``recipe``; None where none suits.

    Arm, observation, control periods and law must agree.
    """
    if recipe.warm is None:
        return None
    try:
        policy = shelf_policy(arm)
    except ContractError:
        return None
    law, task, contract = policy.contract.law, recipe.task, policy.contract
    sizes = (contract.observation_size, *recipe.warm.actor_layers, arm.joints)
    shapes = [matrix.shape for matrix in network_weights(policy.content)[::2]]
    suits = (
        contract.layout == task.layout
        and law == replace(task.law, stiffness=law.stiffness, decay_start=law.decay_start)
        and contract.min_period <= task.min_period
        and task.max_period <= contract.max_period
        and shapes == list(zip(sizes[1:], sizes, strict=False))
    )
    return begin_at(policy.content) if suits else None


def begin_at(content: bytes) -> Tensor:
    """All weights of a policy file's ``content``, checked by `Policy.load`, layer by layer."""
    return torch.cat([torch.from_numpy(values.copy()).ravel() for values in network_weights(content)])


def network_weights(content: bytes) -> tuple[NDArray[np.float32], ...]:
    """Matrix and bias of each layer of a policy file's ``content``, checked by `Policy.load`."""
    graph = onnx.load_from_string(content).graph
    known = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    return tuple(known[name] for node in graph.node if node.op_type == "Gemm" for name in node.input[1:])
