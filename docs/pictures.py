"""Draw the strips of pictures that the pages of the tasks show.

Run: python docs/pictures.py [name ...]      (writes docs/images/<name>.png)
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np

import multilift_marl as ml
from multilift_marl.policies.baselines import SCRIPTED, make_scripted
from multilift_marl.rendering import Renderer

WIDTH, HEIGHT, GAP = 480, 360, 6  # [pixels]
TRAIL = 1.0  # [s]
MIXED = {"vehicle.preset": ("falcon", "falcon", "hummingbird", "iris")}
ACC_RATES = {"control.action": "acc_rates"}
ROUTE = {**ACC_RATES, "task_options.map": 3}
STRIPS: dict[str, tuple[str, dict, str, int, tuple[float, ...]]] = {
    # name: configuration, overrides, script or shipped policy, seed, times [s]
    "hover": ("hover", {}, "hover", 3, (0.02, 0.6, 4.0)),
    "pose": ("pose", {}, "payload_geometric", 1, (0.02, 1.6, 3.6)),
    "takeoff": ("takeoff", {}, "formation_integral", 0, (0.02, 3.5, 6.0, 9.0)),
    "land": ("land", {}, "formation_integral", 0, (1.0, 4.0, 7.0, 11.5)),
    "gate": ("gate", {}, "gate", 2, (3.0, 5.6, 6.4, 8.0)),
    "recover": ("recover", {}, "formation", 0, (0.02, 0.4, 1.0, 4.0)),
    "loss": ("loss", {}, "loss", 0, (1.5, 4.4, 11.0)),
    "navigate": ("navigate_narrow", ROUTE, "mpc_route", 0, (2.5, 4.5, 6.5)),
    "navigate_dense": ("navigate_dense", ROUTE, "mpc_route", 0, (2.5, 4.5, 6.5)),
    "navigate_low": ("navigate_low", ROUTE, "mpc_route", 0, (0.02, 3.2, 6.0)),
    "navigate_sparse": ("navigate", ROUTE, "mpc_route", 0, (2.5, 4.5, 6.5)),
    "navigate_unknown": ("navigate_unknown", ROUTE, "mpc_route", 0, (2.5, 4.5, 6.5)),
    "coltrans": ("maps/coltrans_forest", {**ACC_RATES, "env.num_drones": 6}, "mpc_route", 0, (1.0, 2.3, 3.4)),
    "mixed_team": ("hover", MIXED, "formation_integral", 0, (0.02, 6.0)),
}

OWN_CAMERAS = {"gate": "chase", "navigate_low": "side"}
CAMERAS = {name: "chase" for name, strip in STRIPS.items() if strip[2] == "mpc_route"} | OWN_CAMERAS


def draw(name: str) -> np.ndarray:
    """Return the pictures of a strip, side by side (H, W, 3) uint8."""
    config, overrides, policy_name, seed, times = STRIPS[name]
    vec = ml.make_vec(config, num_envs=1, **overrides)
    policy = make_scripted(policy_name, vec) if policy_name in SCRIPTED else ml.load_policy(policy_name)
    observation, _ = vec.reset(seed=seed)
    policy.reset()
    white, frames = np.full((HEIGHT, GAP, 3), 255, np.uint8), []
    with Renderer(vec, width=WIDTH, height=HEIGHT, camera=CAMERAS.get(name, "side"), trail=TRAIL) as renderer:
        for step in range(1, vec.max_steps + 1):
            observation, _, terminated, truncated, _ = vec.step(policy.act(observation))
            ahead = np.array(times) - step * vec.task.dt
            if (np.any((ahead > -1e-9) & (ahead < TRAIL)) and step % 3 == 0) or np.any(np.abs(ahead) < 1e-9):
                picture = renderer.frame()  # also between pictures, for the trails
            if np.any(np.abs(ahead) < 1e-9):
                frames += [picture, white]
            if terminated[0] or truncated[0]:
                break
    assert len(frames) == 2 * len(times), f"{name} ended after {step * vec.task.dt:.2f} s"
    return np.concatenate(frames[:-1], axis=1)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or STRIPS:
        path = Path(__file__).parent / "images" / f"{chosen}.png"
        iio.imwrite(path, draw(chosen))
        print(f"wrote {path}")
