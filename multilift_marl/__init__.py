"""Multi-agent reinforcement learning for cooperative aerial transport on MuJoCo."""

from multilift_marl import sim
from multilift_marl.config import load_config
from multilift_marl.envs.core import make_vec
from multilift_marl.tasks import list_tasks

__version__ = "0.1.0"
__all__ = ["list_tasks", "load_config", "make_vec", "sim"]
