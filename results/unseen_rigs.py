"""The shipped policy of `hover`, trained on one rig, and baselines on rigs that it has not seen, on the same episodes.

  python results/unseen_rigs.py [episodes=20]     all rigs -> docs/data/unseen_rigs.csv (fewer episodes: not kept)

The policy was trained with four falcons, cables of equal length and a plate of 1.2 kg. A hidden mass (± 20 %) and force
(to 0.12 of the payload's weight) are drawn on every rig.
"""

from __future__ import annotations

import csv
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from flights import ROOT
from script import read_options, run_script

from multilift_marl.agents.policy import load_policy
from multilift_marl.config.load import load_config
from multilift_marl.evaluation.metrics import bootstrap, wilson
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.evaluation.suites import list_shifts
from multilift_marl.policies.baselines import make_scripted

EPISODES, SEED = 250, 2000
TABLE = ROOT / "docs" / "data" / "unseen_rigs.csv"
BASELINES = ("formation", "formation_integral", "formation_feedback", "payload_geometric")
L_SHAPE = [(0, 0), (0.9, 0), (0.9, 0.3), (0.3, 0.3), (0.3, 0.7), (0, 0.7)]  # [m] counter-clockwise, 0.1 m thick

RIGS: dict[str, dict[str, Any]] = {
    "as in training": {},
    **{rig.title: rig.overrides for rig in list_shifts(4, "rigs")},  # those of the benchmark, too
    "five drones, L-shaped payload of 2 kg, cables of 0.6 to 1 m": {
        "env.num_drones": 5,
        "payload.mass": 2.0,
        "payload.shape": "mesh",
        "payload.anchors": [[0.02, 0.02, 0.1], [0.5, 0.02, 0.1], [0.88, 0.15, 0.1], [0.28, 0.6, 0.1], [0.02, 0.5, 0.1]],
        "payload.origin": "file",
        "cable.length": [0.8, 0.6, 1.0, 0.7, 0.9],
    },
    "cables as chains of 20 g": {"cable.model": "chain"},
}


def write_prism(path: Path, outline: list[tuple[float, float]], height: float) -> None:
    """Write an upright prism over a polygon as an OBJ file [m]."""
    n = len(outline)
    lines = [f"v {x} {y} {z}" for z in (0.0, height) for x, y in outline]
    lines += [f"f {' '.join(str(i) for i in range(n, 0, -1))}", f"f {' '.join(str(n + i) for i in range(1, n + 1))}"]
    lines += [f"f {i + 1} {(i + 1) % n + 1} {n + (i + 1) % n + 1} {n + i + 1}" for i in range(n)]
    path.write_text("\n".join(lines) + "\n")


def evaluate(rig: str, overrides: dict[str, Any], episodes: int) -> list[dict[str, str]]:
    """Return a row for the policy and one for each baseline."""
    mass = overrides.get("payload.mass", 1.2)
    config = load_config("hover", overrides | {"randomization.payload_force": 0.12 * 9.81 * mass})
    rows = []
    makers = {"learned": load_policy("hover").bind} | {name: partial(make_scripted, name) for name in BASELINES}
    for name, maker in makers.items():
        flown = run_episodes(config, maker, episodes, SEED)
        error = flown["payload_position_error_m"]
        success, (low, high) = flown["success_rate"], bootstrap(error)
        least, most = wilson(int(success.sum()), episodes)
        row = {"rig": rig, "team": name, "episodes": str(episodes)}
        row |= {
            "success_percent": f"{100 * success.mean():.1f}",
            "success_ci95": f"{100 * least:.1f}-{100 * most:.1f}",
            "position_error_cm": f"{100 * error.mean():.2f}",
        }
        rows.append(row | {"position_error_ci95_cm": f"{100 * low:.2f}-{100 * high:.2f}"})
        print(" ".join(f"{key}={value}" for key, value in rows[-1].items()), flush=True)
    return rows


def main(arguments: list[str]) -> None:
    """Evaluate, print and, with all episodes, write."""
    episodes = read_options(arguments, {"episodes": EPISODES})["episodes"]
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "l_shape.obj"
        write_prism(mesh, L_SHAPE, 0.1)
        rows = []
        for title, overrides in RIGS.items():
            own = overrides | ({"payload.mesh": str(mesh)} if overrides.get("payload.shape") == "mesh" else {})
            rows += evaluate(title, own, episodes)
    if episodes == EPISODES:
        with open(TABLE, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    run_script(main)
