"""Pictures and videos of a team, drawn off-screen without a display, and windows."""

from multilift_marl.rendering.cameras import CAMERAS
from multilift_marl.rendering.draft import Draft
from multilift_marl.rendering.renderer import Renderer, VideoWriter, write_video
from multilift_marl.rendering.scene import Stage
from multilift_marl.rendering.window import Window

__all__ = ["CAMERAS", "Draft", "Renderer", "Stage", "VideoWriter", "Window", "write_video"]
