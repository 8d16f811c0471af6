"""Teaching a policy on randomised twins: the task, PPO and the export.

Torch's threads are to sleep while they wait for one another: by default they turn in place for milliseconds, at each of
thousands of small products, and where other programs want the processor as well a training takes many times as long.
It is read when torch is first imported, and what it computes stays the same.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
