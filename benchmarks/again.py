"""How well an arm's twin predicts a second excitation: with other noise, and after hours of work."""

import rejoint
from rejoint.runs.repair import WORSE, twin_error

HOURS = (0, 0, 50, 150, 400)


def main(arms: int = 3, first: int = 3) -> None:
    arm = rejoint.load_arm("mycobot280")
    print(f"a twin is kept up to {WORSE:g} times its own error on motion it had not seen")
    for seed in range(first, first + arms):
        robot = f"emulated:worn?seed={seed}"
        twin = rejoint.identify(rejoint.diagnose(robot, settings=rejoint.Settings(seed=0)).excitation, arm=arm)
        own, found = twin.held_out.twin.tcp, []
        for noise, hours in enumerate(HOURS, start=1):
            again = rejoint.diagnose(f"{robot}&hours={hours}", settings=rejoint.Settings(seed=noise))
            found.append(f"{hours} h {twin_error(arm, twin, again.excitation) / own:.2f}")
        print(f"arm {seed}: {1e3 * own:.2f} mm; times that: {', '.join(found)}", flush=True)
