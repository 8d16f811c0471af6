"""Twins on a GPU: the batch of `rejoint.twin.chain.batch`, its steps taken by a kernel of NVIDIA Warp.

State and parameters stay on this side; they are sent before the steps of a call, and positions and speeds come back
after them. A GPU pays where arms are many, as in training, and not for the one that is driven.
"""

from __future__ import annotations

import logging
from functools import partial
from types import ModuleType

from rejoint.arms import Arm, Array
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.twin.chain.batch import ChainBatch
from rejoint.twin.declaration import TIMESTEP

CPU = "cpu"
"""The device that is none: twins are then stepped by `ChainBatch`"""


def device_at_hand(wanted: str) -> str | None:
    """Return the device of Warp that is ``wanted``, ``cuda`` or ``cuda:1``; None, and a warning, where there is none.

    None as well for `CPU`. MissingExtraError without Warp, InputError for another device.
    """
    if wanted == CPU:
        return None
    if wanted.partition(":")[0] != "cuda":
        raise InputError(f"--device {wanted}: expected cpu, cuda, or a GPU by its number, such as cuda:1")
    warp = _warp()
    known = [str(device) for device in warp.get_cuda_devices()]
    if wanted == "cuda" and known:
        return known[0]
    if wanted in known:
        return wanted
    found = f"only {', '.join(known)}" if known else "no GPU that CUDA could use"
    logging.getLogger("rejoint").warning("%s: there is %s; the processors simulate the twins", wanted, found)
    return None


def _warp() -> ModuleType:
    require("--device cuda", "gpu")
    import warp

    warp.config.log_level = warp.LOG_ERROR
    return warp


class WarpBatch(ChainBatch):
    """``nsim`` simulations of one arm on ``device``, as Warp calls it: ``cuda``, ``cuda:1``, or ``cpu`` to try it."""

    def __init__(self, arm: Arm, nsim: int, timestep: float = TIMESTEP, *, device: str) -> None:
        """Compile the kernel, or take it from Warp's folder; MissingExtraError without Warp."""
        self._warp = _warp()
        from rejoint.twin.chain.warpstep import step_kernel

        super().__init__(arm, nsim, timestep)
        self._kernel, self._device = step_kernel(arm.joints), device
        self._warp.load_module(self._kernel.module, device=device)

    def _advance(self, terms: Array, steady: bool, control: Array, path: Array) -> None:
        wp, device = self._warp, self._device
        sent = partial(wp.array, dtype=wp.float64, device=device)
        state = [sent(array) for array in (self.qpos, self.qvel, self._impulse, path)]
        given = [sent(array) for array in (self._links, self._parameters, terms)]
        rest = [sent(array) for array in (self._gravity, self.timestep, control)]
        wp.launch(self._kernel, dim=self.nsim, inputs=[*given, steady, *rest, *state], device=device)
        for array, there in zip((self.qpos, self.qvel, self._impulse, path), state, strict=True):
            array[...] = there.numpy()
