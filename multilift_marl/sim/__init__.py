"""Physics: vehicles, cables and payload on MuJoCo."""

from multilift_marl.sim.scene import build_model
from multilift_marl.sim.state import Air, EpisodeStats, HiddenLoads, SystemState
from multilift_marl.sim.world import World

__all__ = ["Air", "EpisodeStats", "HiddenLoads", "SystemState", "World", "build_model"]
