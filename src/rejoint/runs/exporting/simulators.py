"""A twin for other simulators: a model for MuJoCo 4, and an actuator configuration for Isaac Lab.

The law of `rejoint.twin.table`. MuJoCo's ``pid`` delays the command and limits the speed of the reference, its passive
``dcmotor`` has dry friction with Stribeck's law by LuGre's bristles (Canudas de Wit et al. 1995).
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from rejoint.arms import Arm
from rejoint.pages.html import render
from rejoint.twin.parameters import STRIBECK_SPEED, back_emf
from rejoint.twin.table import twin_spec
from rejoint.twin.twin import Twin

STEP = 0.0005
"""[s] of the model; chosen: at twice as much, bristles are too soft"""
BRISTLES = 1000.0
"""[rad/s] natural frequency of a joint on its bristles; chosen: half a radian in a step"""


def mjcf_text(arm: Arm, twin: Twin) -> str:
    """MuJoCo model of ``arm`` with the servos of its twin; its comment names what is missing."""
    spec, p, dry = twin_spec(arm), twin.parameters, twin.parameters.coulomb
    beside = back_emf(arm, p)
    option = spec.option
    option.timestep, option.disableflags = STEP, 0
    # the implicit integrators take bristles for viscous, which is as much inertia again (measured)
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.solver, option.jacobian = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtJacobian.mjJAC_AUTO
    spec.compiler.degree = False
    for joint, armature in zip(spec.joints, p.armature, strict=True):
        joint.armature = armature
    inertia, delay = 1.0 / spec.compile().dof_invweight0, max(float(p.delay), 0.0)
    for i, (joint, servo) in enumerate(zip(spec.joints, spec.actuators, strict=True)):
        stiffness, limit = float(p.stiffness[i]), float(p.torque_limit[i])
        joint.limited, joint.range = True, (arm.lower[i], arm.upper[i])
        joint.damping = beside[i], 0.0, 0.0
        joint.frictionloss = 0.0
        servo.set_to_pid(
            kp=stiffness,
            kv=float(p.damping[i] - beside[i]),
            slewmax=float(p.ramp_speed),
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_POS),
        )
        servo.biasprm[0], servo.forcerange = stiffness * p.offset[i], (-limit, limit)
        if delay:
            servo.delay, servo.nsample = delay, math.ceil(delay / STEP) + 1
        friction = spec.add_actuator(name=f"{joint.name}_friction", target=joint.name)
        friction.trntype = mujoco.mjtTrn.mjTRN_JOINT
        friction.set_to_dcmotor(
            motorconst=(0.0, 0.0),
            resistance=1.0,  # without a motor, but MuJoCo asks for one
            lugre=(inertia[i] * BRISTLES**2, inertia[i] * BRISTLES, dry[i], twin.stiction * dry[i], STRIBECK_SPEED),
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_NONE),
        )
    rest = arm.rest.tolist()
    spec.add_key(name="rest", qpos=rest, ctrl=rest, act=[*rest, *[0.0] * arm.joints])
    lines = [
        f"The arm {arm.name} with its servos as rejoint found them, for MuJoCo 4. ctrl: commanded positions in rad.",
        "Begin with the keyframe, or set the first values of act, the references, to where the arm is.",
        *_missing(arm, twin),
    ]
    if twin.acceleration < math.inf:
        lines.append(f"The references of the servos also accelerate by at most {twin.acceleration:.4g} rad/s^2.")
    spec.comment = "\n".join(lines)
    spec.compile()
    return str(spec.to_xml())


def isaaclab_text(arm: Arm, twin: Twin) -> str:
    """Python text with the ``actuators`` of Isaac Lab's ``ArticulationCfg``, versions 2.3 and 3."""
    about = {"arm": arm, "p": twin.parameters, "stiction": twin.stiction, "missing": _missing(arm, twin)}
    return render("export/isaaclab.py.txt", by_joint=_by_joint, **about) + "\n"


def _by_joint(arm: Arm, values: Any) -> dict[str, float]:  # noqa: ANN401
    return {name: float(f"{value:.5g}") for name, value in zip(arm.joint_names, values, strict=True)}


def _missing(arm: Arm, twin: Twin) -> list[str]:
    """Say what neither simulator has, and what no motion has told."""
    p = twin.parameters
    lines = ["Backlash inside the servos is not here: motion does not tell it from dry friction."]
    if np.any(p.compensation):
        share = _by_joint(arm, p.compensation / p.stiffness)
        lines.append(f"The controller feeds gravity forward: add its torques, times {share}, to the commands.")
    if p.delay < 0:
        lines.append(f"Positions were read {-1e3 * float(p.delay):.0f} ms after their stamps, which is left out.")
    if twin.unknown:
        lines.append(f"As assumed before, for the motion did not tell: {', '.join(twin.unknown)}.")
    return lines
