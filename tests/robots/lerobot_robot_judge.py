"""LeRobot's own base classes as judges of `lerobot_robot_rejoint`: run with the arm's port, a run and a program.

Discovery, the registered type, the making from a configuration, features, observations, actions and the end are as
LeRobot's own programs use them. Writes what it saw to standard output, as JSON.
"""

import json
import sys
import time
import tomllib
from dataclasses import make_dataclass
from pathlib import Path

from lerobot_judge import stand_in, stand_in_for_what_the_bus_does_not_use

PLUG_IN = Path(__file__).parents[2] / "integrations" / "lerobot_robot_rejoint"


def as_installed(folder):
    """Have Python find the plug-in as an installed distribution, by the name in its pyproject.toml."""
    project = tomllib.loads((PLUG_IN / "pyproject.toml").read_text())["project"]
    info = Path(folder) / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    sys.path[:0] = [str(PLUG_IN), str(folder)]


def judge(port, run, program, folder):
    stand_in("lerobot.processor", RobotAction=dict, RobotObservation=dict)  # types alone, and needs torch
    stand_in("huggingface_hub")
    stand_in("huggingface_hub.constants", HF_HOME=folder)
    as_installed(folder)
    import draccus
    from lerobot.robots import Robot, RobotConfig, make_robot_from_config
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()  # finds what is installed by its name
    assert "lerobot_robot_rejoint" in sys.modules
    words = {"type": "rejoint_so101", "id": "mine", "port": port, "run": run, "rejoint": program}
    asked = make_dataclass("Asked", [("robot", RobotConfig)])  # as LeRobot's programs have it among others
    config = draccus.parse(asked, args=[f"--robot.{name}={word}" for name, word in words.items()]).robot
    robot = make_robot_from_config(config)
    seen = {"type": config.type, "robot": isinstance(robot, Robot), "abstract": sorted(robot.__abstractmethods__)}
    seen["features"] = [sorted(robot.observation_features), sorted(robot.action_features)]
    seen["connected"] = [robot.is_connected]
    robot.connect()
    seen["connected"].append(robot.is_connected)
    seen["calibrated"] = robot.is_calibrated
    start = robot.get_observation()
    goal = {name: angle + 8.0 for name, angle in start.items() if name != "gripper.pos"} | {"gripper.pos": 60.0}
    began = time.monotonic()
    for step in range(1, 61):  # two seconds of teleoperation at 30 Hz
        share = min(step / 30, 1.0)
        robot.get_observation()
        sent = robot.send_action({name: start[name] + share * (goal[name] - start[name]) for name in goal})
        time.sleep(max(began + step / 30 - time.monotonic(), 0.0))
    seen["rate"] = 60 / (time.monotonic() - began)
    time.sleep(1.5)
    seen |= {"start": start, "goal": goal, "sent": sent, "end": robot.get_observation()}
    seen["clipped"] = robot.send_action({"wrist_flex.pos": 170.0})["wrist_flex.pos"]
    try:
        robot.send_action({"wrist_flex.pos": float("nan")})
    except ValueError as error:
        seen["refused"] = str(error)
    robot.disconnect()
    seen["connected"].append(robot.is_connected)
    robot.connect()
    there = robot.get_observation()["wrist_flex.pos"]
    seen["moved"] = robot.send_action({"shoulder_pan.pos": 0.0})["wrist_flex.pos"] - there
    robot.disconnect()
    return seen


if __name__ == "__main__":
    stand_in_for_what_the_bus_does_not_use()
    sys.stdout.write(json.dumps(judge(*sys.argv[1:])) + "\n")
