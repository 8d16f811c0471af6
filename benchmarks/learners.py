"""A training to take times of: the default recipe on the broad ranges of a myCobot 280."""

from rejoint.arms import mycobot280
from rejoint.training.learner import Learner
from rejoint.training.presets import DEFAULT
from rejoint.training.train import TrainingOptions, know_stiffness, make_learner

ROLLOUT = DEFAULT.ppo.rollout


def begin(agents: int = DEFAULT.ppo.agents) -> Learner:
    """Start a training on two threads and do its first update."""
    arm, options = mycobot280(), TrainingOptions(agents=agents, threads=2)
    learner = make_learner(arm, None, know_stiffness(options.recipe, arm, None), options)
    learner.iterate()
    return learner
