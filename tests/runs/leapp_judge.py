"""NVIDIA's reader runs a bundle: states in (one a row, from a file), commands out. Run by `test_exporting.py`."""

import sys

import numpy as np
import torch
from leapp import InferenceManager

bundle, states, out = sys.argv[1:]
manager, found = InferenceManager(bundle), []
for row in np.load(states):
    feed = {"joint_pos": row[None, :-4], "target": row[None, -4:-1], "period": row[None, -1:]}
    answer = manager.run_policy({f"controller/{name}": torch.tensor(value) for name, value in feed.items()})
    found.append(answer["controller/joint_command"].numpy()[0])
np.save(out, np.array(found))
