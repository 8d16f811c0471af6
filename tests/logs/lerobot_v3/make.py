"""Write the dataset beside this file with LeRobot's own writer: `pip install lerobot==0.4.4`, then run this."""

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def main(folder: Path) -> None:
    feature = {"dtype": "float32", "shape": (6,), "names": [f"{motor}.pos" for motor in MOTORS]}
    dataset = LeRobotDataset.create(
        "example/so101",
        fps=30,
        root=folder,
        robot_type="so101_follower",
        use_videos=False,
        features={"observation.state": feature, "action": feature},
    )
    for episode in range(2):
        for frame in range(40 + 10 * episode):
            action = 20 * np.sin(0.1 * frame * np.arange(1, 7)) + episode
            state = 20 * np.sin(0.1 * max(frame - 2, 0) * np.arange(1, 7)) + episode
            dataset.add_frame(
                {
                    "observation.state": state.astype(np.float32),
                    "action": action.astype(np.float32),
                    "task": "move",
                }
            )
        dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
