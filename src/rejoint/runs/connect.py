"""The public session: an arm to drive, and the stages of a repair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rejoint.session.inputs import ArmLike, RobotLike, RunLike, Settings, Targets
from rejoint.session.session import ArmSession

if TYPE_CHECKING:
    from rejoint.control.recording import Observer
    from rejoint.runs.stages.calibrate import Calibrated
    from rejoint.runs.stages.compare import Compared, TrialPlan
    from rejoint.runs.stages.diagnose import Diagnosed
    from rejoint.runs.stages.train import TrainedPolicy
    from rejoint.session.context import Controllers
    from rejoint.session.inputs import GaugeLike
    from rejoint.twin.twin import Twin


class Session(ArmSession):
    """An arm with everything that drives it, see `rejoint.connect`; its run takes up what a stage finds.

    One motion at a time, always guarded; between motions the arm holds. Before its first motion to a point or along a
    path it goes slowly to its rest posture. Use it in a ``with`` block.

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.diagnose(), arm.identify(), arm.train(), arm.compare()
    ...     arm.move_to([0.2, 0.05, 0.18])  # by the controller that the comparison recommends
    """

    def diagnose(self, *, quick: bool = False) -> Diagnosed:
        """Excite the arm and say what is wrong with it; as `rejoint.diagnose`."""
        from rejoint.runs.stages.diagnose import diagnose

        with self.lent() as run:
            return diagnose(self.robot, run=run, quick=quick, settings=self.settings, observer=self.observer)

    def calibrate(self, gauge: GaugeLike | None = None, *, count: int | None = None) -> Calibrated:
        """Find out where the tool really is; as `rejoint.calibrate`."""
        from rejoint.runs.stages.calibrate import calibrate

        with self.lent() as run:
            return calibrate(
                self.robot, run=run, gauge=gauge, count=count, settings=self.settings, observer=self.observer
            )

    def identify(self, *, quick: bool = False) -> Twin:
        """Fit a twin to what the diagnosis recorded; as `rejoint.identify`."""
        from rejoint.runs.stages.identify import identify

        with self.lent() as run:
            return identify(run=run, quick=quick, observer=self.observer)

    def train(self, *, quick: bool = False) -> TrainedPolicy:
        """Train a policy on copies of the twin; as `rejoint.train`."""
        from rejoint.runs.stages.train import train

        with self.lent() as run:
            return train(run=run, quick=quick, observer=self.observer)

    def compare(
        self, controllers: Controllers = (), targets: Targets | None = None, *, plan: TrialPlan | None = None
    ) -> Compared:
        """Try controllers on the arm and recommend one; as `rejoint.compare`."""
        from rejoint.runs.stages.compare import compare

        with self.lent() as run:
            return compare(
                self.robot, controllers, targets, run=run, plan=plan, settings=self.settings, observer=self.observer
            )


def connect(
    address: RobotLike,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Session:
    """Connect to an arm, to drive it under the guard; nothing moves yet.

    Without a guard: `rejoint.open_robot`.

    Parameters
    ----------
    address
        ``emulated:worn`` (virtual time), ``tcp://HOST:PORT``, ``serial:///dev/DEVICE``, ``feetech:///dev/DEVICE``, or
        an open robot
    run
        run, or its folder, for twin, calibration, recommended controller and logs; without one the generic policy
        drives, if this arm has one
    arm
        arm, name or file; default: by the run or the address
    settings
        controller, payload, control period and the like
    observer
        receives messages, progress, control cycles

    Returns
    -------
    Session
        the arm

    Raises
    ------
    AddressError
        if nothing usable is there
    MissingExtraError
        for an emulated arm without the simulator
    InputError, ContractError
        if run, controller and arm do not fit

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    >>> settings = rejoint.Settings(payload=0.1)
    >>> arm = rejoint.connect("emulated:worn", settings=settings)
    """
    found = Session(address, run=run, arm=arm, settings=settings, observer=observer)
    try:
        found.driver()
        found.correction  # noqa: B018 - what does not fit is refused now
        return found.open()
    except BaseException as error:
        found.__exit__(type(error), error, error.__traceback__)
        raise
