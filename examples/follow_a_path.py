"""Send an arm to a point, then along a circle, then behind targets that come as it goes."""

import argparse

import numpy as np

import rejoint

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("run", help="run folder of the arm, as `rejoint repair` or `rejoint identify` left it")
options.add_argument("--robot", default="emulated:worn", help="address of the robot")
options.add_argument("--seconds", type=float, default=8.0, help="for the circle")
chosen = options.parse_args()

time = np.linspace(0.0, chosen.seconds, 200)
angle = 2.0 * np.pi * time / chosen.seconds
place = np.array([0.18, 0.0, 0.20]) + 0.02 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)

with rejoint.connect(chosen.robot, run=chosen.run) as arm:
    state = arm.move_to(place[0], within_m=0.005)
    print(f"point: {1e3 * state.error_m:.1f} mm off")

    done = arm.follow(rejoint.Path(time=time, place=place, name="circle"))
    print(f"circle: {1e3 * done.passes[-1].encoder.rms:.1f} mm off, root mean square")

    stream = rejoint.Stream()  # of a person, a camera, a learned policy: another thread may put targets as they come
    for moment in np.arange(0.0, 4.0, 1.0 / 30.0):
        stream.put(place[0] + [0.0, 0.0, 0.01 * min(moment, 2.0)], time=moment)
    arm.follow(stream, duration_s=4.0, wait=False)
    print(f"stream: the tool stands at {np.round(1e3 * arm.wait().tool_m).astype(int)} mm")
