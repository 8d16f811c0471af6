"""Teaching a policy on randomised twins: the task, PPO and the export."""
