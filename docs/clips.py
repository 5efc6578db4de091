"""Draw the short animations of README.md and of the gallery.

Run: python docs/clips.py [name ...]      (writes docs/images/<name>.gif)
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

import multilift_marl as ml
from multilift_marl.policies.baselines import SCRIPTED, make_scripted
from multilift_marl.rendering import Renderer

COLOURS = 128  # of a palette that all frames share, so that what stands still takes no space
TRAIL = 1.0  # [s]

ROUTE = {"control.action": "acc_rates", "task_options.map": 3}


class Clip(NamedTuple):
    """What a clip shows; the policy is a shipped one or a baseline."""

    config: str
    policy: str
    seed: int
    start: float  # [s] into the episode
    seconds: float  # of the episode
    overrides: dict[str, Any] = {}  # noqa: RUF012
    camera: str = "side"
    speed: float = 1.0  # seconds of the episode in a second of the clip
    width: int = 320
    height: int = 240
    fps: int = 10
    most: int = 300_000  # [bytes]


CLIPS = {
    "navigate_senses": Clip(
        "navigate_course", "navigate_senses", 3, 5.0, 27.0, {}, "chase", 3.0, 520, 292, 10, 1_900_000
    ),
    "navigate_slots": Clip("navigate_slots", "navigate_slots", 8, 13.0, 10.0, {}, "chase", 2.0, 480, 270, 10, 900_000),
    "clip_gate": Clip("gate_two", "formation_narrow", 0, 2.0, 8.0, {}, "chase", 2.0),
    "clip_hover": Clip("hover", "hover", 3, 0.0, 3.0),
    "clip_land": Clip("land", "land", 0, 2.0, 10.0, {}, "side", 2.5),
    "clip_loss": Clip("loss", "loss", 0, 2.5, 5.0),
    "clip_navigate": Clip("navigate_dense", "mpc_route", 1, 0.5, 9.5, ROUTE, "chase", 2.0, most=800_000),
    "clip_pose": Clip("pose", "pose", 1, 0.0, 8.0, {}, "side", 2.0),
    "clip_recover": Clip("recover", "recover", 0, 0.0, 2.5, {}, "side", 0.5),
    "clip_regroup": Clip("regroup_senses", "regroup_senses", 3, 3.0, 7.5, {}, "side", 2.0, most=400_000),
    "clip_takeoff": Clip("takeoff", "takeoff", 0, 2.0, 7.0, {}, "side", 2.0),
    "clip_track": Clip("track", "track", 0, 4.0, 8.0, {}, "top", 2.0),
}


def film(clip: Clip) -> list[np.ndarray]:
    """Return the frames (H, W, 3) uint8 of a clip."""
    vec = ml.make_vec(clip.config, num_envs=1, **clip.overrides)
    policy = make_scripted(clip.policy, vec) if clip.policy in SCRIPTED else ml.load_policy(clip.policy).bind(vec)
    observation, _ = vec.reset(seed=clip.seed)
    policy.reset()
    frames: list[np.ndarray] = []
    with Renderer(vec, width=clip.width, height=clip.height, camera=clip.camera, trail=TRAIL) as renderer:
        for step in range(1, vec.max_steps + 1):
            observation, _, terminated, truncated, _ = vec.step(policy.act(observation))
            ahead = step * vec.task.dt - clip.start
            due = ahead * clip.fps / clip.speed
            if ahead >= -TRAIL and int(due) != int(due - vec.task.dt * clip.fps / clip.speed):
                picture = renderer.frame()  # also before the clip begins, for the trails
                if ahead >= 0.0:
                    frames.append(picture)
            if terminated[0] or truncated[0] or ahead >= clip.seconds:
                break
    assert not terminated[0], f"failed after {step * vec.task.dt:.2f} s"
    return frames


def write(frames: list[np.ndarray], path: Path, fps: int) -> None:
    """Write an animation that repeats."""
    palette = choose_palette(np.array(frames[::3]))
    first, *others = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def choose_palette(frames: np.ndarray) -> Image.Image:
    """Return an image with the palette of frames (F, H, W, 3); a colour weighs by the root of how many pixels have it.

    By their number alone drones and cables, which are few pixels, would lose their colours to the sky.
    """
    pixels = frames.reshape(-1, 3)
    shades = (pixels >> 2).astype(np.int64) @ [1 << 12, 1 << 6, 1]
    _, index, count = np.unique(shades, return_index=True, return_counts=True)
    weighted = np.repeat(pixels[index], np.ceil(np.sqrt(count)).astype(int), axis=0)
    return Image.fromarray(weighted[None]).quantize(COLOURS, kmeans=3, dither=Image.Dither.NONE)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or CLIPS:
        target = Path(__file__).parent / "images" / f"{chosen}.gif"
        write(film(CLIPS[chosen]), target, CLIPS[chosen].fps)
        size = target.stat().st_size
        assert size <= CLIPS[chosen].most, f"{target} has {size} bytes, more than {CLIPS[chosen].most}"
        print(f"wrote {target}, {size // 1000} kB", flush=True)
