"""Pictures and videos of a team, drawn off-screen: no display is needed, and none is opened."""

from multilift_marl.rendering.cameras import CAMERAS
from multilift_marl.rendering.renderer import Renderer
from multilift_marl.rendering.stage import Stage
from multilift_marl.rendering.video import VideoWriter, write_video

__all__ = ["CAMERAS", "Renderer", "Stage", "VideoWriter", "write_video"]
