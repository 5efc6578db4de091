"""Score the scripted teams on every task: 200 episodes of seed 1000 each, the same for all.

Run: python bench/scripts.py [episodes] [--document docs/tasks.md]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from multilift_marl.config.load import load_config
from multilift_marl.control.scripted import SCRIPTED, make_scripted
from multilift_marl.evaluation.metrics import summarize
from multilift_marl.evaluation.rollout import fly_episodes

SEED = 1000
MARKER = "<!-- scores -->\n"
FLIGHTS: dict[str, tuple[str, dict]] = {  # name: configuration, overrides
    "hover": ("hover", {}),
    "pose_easy": ("pose_easy", {}),
    "pose": ("pose", {}),
    "track_circle, 0.2 rad/s": ("track_circle", {}),
    "track_circle, 0.4 rad/s": ("track_circle", {"task_options.rate": 0.4}),
    "track, 1 m/s, 0.5 m/s²": ("track", {}),
    "track, 2 m/s, 2 m/s²": ("track", {"task_options.speed": 2.0, "task_options.acceleration": 2.0}),
    "track, 2 m/s, 4 m/s²": ("track", {"task_options.speed": 2.0, "task_options.acceleration": 4.0}),
    "track, 5 m/s, 8 m/s²": ("track", {"task_options.speed": 5.0, "task_options.acceleration": 8.0}),
    "takeoff": ("takeoff", {}),
    "land": ("land", {}),
    "gate": ("gate", {}),
    "gate_two": ("gate_two", {}),
    "recover": ("recover", {}),
    "recover_crazymarl": ("recover_crazymarl", {}),
    "loss": ("loss", {}),
    "loss, 6 drones": ("loss", {"env.num_drones": 6}),
    "loss_snap": ("loss_snap", {}),
}


def main() -> None:
    """Print the table, and write it after the marker of a document if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("episodes", nargs="?", type=int, default=200)
    parser.add_argument("--document", type=Path, help="where the table replaces the one after <!-- scores -->")
    asked = parser.parse_args()
    lines = [
        f"| | {' | '.join(f'{name}: success [%] | error [cm]' for name in SCRIPTED)} |",
        f"|---|{'---|---|' * len(SCRIPTED)}",
    ]
    print(*lines, sep="\n")
    for name, (config, overrides) in FLIGHTS.items():
        cells = [name]
        for script in SCRIPTED:
            settings = load_config(config, overrides)
            told = summarize(
                fly_episodes(settings, lambda vec, script=script: make_scripted(script, vec), asked.episodes, SEED)
            )
            error = "payload_rmse_m" if settings.task == "track" else "payload_position_error_m"
            cells += [f"{100 * told['success_rate']['mean']:.1f}", f"{100 * told[error]['mean']:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    if asked.document is not None:
        head, marker, rest = asked.document.read_text(encoding="utf-8").partition(MARKER)
        after = rest.partition("\n\n")[2]
        asked.document.write_text(f"{head}{marker}" + "\n".join(lines) + f"\n\n{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
