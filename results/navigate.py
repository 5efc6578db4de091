"""Success among obstacles: `python results/navigate.py [maps=1000] [rows=dense_4,...] [policies=mpc_route,mpc]`.

Each row is a level and a number of drones, flown on held-out maps: evaluation episodes 0 to maps - 1 of seed 1000, the
same for all policies. Finished episodes are kept in results/navigate and not flown again; of all of them a table is
written to docs/data/navigate.csv, and successes of four drones to docs/navigate.md, with maps=0 these alone.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from script import check_known, read_options, run_script

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.metrics import wilson
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.mdp.failures import CAUSES
from multilift_marl.policies.baselines import SCRIPTED, make_scripted

HERE = Path(__file__).parent / "navigate"
DOCS = Path(__file__).parents[1] / "docs"
BEGIN, END = "<!-- table of navigate -->\n", "<!-- end of table -->"
SEED, CHUNK = 1000, 50
LEVELS = "sparse", "dense", "narrow", "low", "unknown"
PUBLIC = "window", "forest", "wall"  # of coltrans-planning, in configs/maps; episodes differ by their starts
ROWS: dict[str, dict[str, object]] = {
    **{f"{level}_{n}": {"env.num_drones": n} for n in (4, 2, 3, 6, 8) for level in LEVELS},
    **{f"{level}_1": {"env.num_drones": 1, "payload.shape": "point"} for level in LEVELS},
    **{f"half_{n}": {"env.num_drones": n, "task_options.gaps": 0.5} for n in (3, 4, 6, 8)},
    "two_4": {"env.num_drones": 4, "task_options.walls": 2},
    "three_4": {"env.num_drones": 4, "task_options.walls": 3},
    **{
        f"{level}_{n}": {"env.num_drones": n, "payload.mass": 0.0054 if n < 5 else 0.01}
        for level in PUBLIC
        for n in (2, 3, 4, 5, 6)
    },
}
"""Level and drones: half: gaps of half the formation's width; two, three: so many walls; or a public map."""
KEPT = (
    "success_rate", "failure_cause", "arrival_time_s", "path_length_ratio", "min_clearance_m", "min_separation_m",
    "cable_tension_max_n", "searches", "search_s", "longest_later_search_s",
)  # fmt: skip


def configuration(row: str) -> str:
    """Return the configuration of a row."""
    level = row.rsplit("_", 1)[0]
    if level in PUBLIC:
        return f"maps/coltrans_{'window3' if row == 'window_3' else level}"
    if level == "sparse":
        return "navigate"
    return f"navigate_{level}" if level in LEVELS else "navigate_narrow"


def fly(row: str, policy: str, maps: int) -> None:
    """Fly what is left of a row's first maps, and keep it."""
    path = HERE / f"{row}_{policy}.npz"
    kept = dict(np.load(path)) if path.exists() else {}
    config = load_config(configuration(row), ROWS[row] | {"control.action": "acc_rates", "env.num_threads": 1})
    while (done := len(kept.get("success_rate", ()))) < maps:
        count = min(CHUNK, maps - done)
        found = run_episodes(config, lambda vec: make_scripted(policy, vec), count, SEED, first=done)
        part = {name: found[name] for name in KEPT if name in found}
        kept = {name: np.concatenate([kept[name], value]) if done else value for name, value in part.items()}
        HERE.mkdir(exist_ok=True)
        np.savez_compressed(path, **kept)
        print(row, policy, done + count, f"{100 * kept['success_rate'].mean():.1f} %", flush=True)


def summary(path: Path) -> dict[str, str]:
    """Return the line of a row and a policy."""
    level, drones, policy = path.stem.split("_", 2)
    kept = dict(np.load(path))
    good = kept["success_rate"].astype(bool)
    low, high = wilson(int(good.sum()), len(good))
    causes = {name: int((kept["failure_cause"] == i).sum()) for i, name in enumerate(CAUSES) if i}
    causes["late"] = int((~good & (kept["failure_cause"] == 0)).sum())
    line = {
        "level": level, "drones": drones, "policy": policy, "maps": str(len(good)),
        "success_percent": f"{100 * good.mean():.1f}", "ci95": f"{100 * low:.1f}-{100 * high:.1f}",
        "failures": " ".join(f"{name}:{count}" for name, count in causes.items() if count),
    }  # fmt: skip
    if good.any():
        line |= {
            "arrival_s": f"{np.median(kept['arrival_time_s'][good]):.1f}",
            "way_over_straight": f"{np.median(kept['path_length_ratio'][good]):.2f}",
            "clearance_median_m": f"{np.median(kept['min_clearance_m'][good]):.3f}",
            "clearance_least_m": f"{kept['min_clearance_m'][good].min():.3f}",
        }
    if "search_s" in kept:
        later = kept["longest_later_search_s"][kept["searches"] > 1]
        line["search_median_ms"] = f"{1e3 * np.median(kept['search_s']):.0f}"
        line["search_largest_ms"] = f"{1e3 * kept['search_s'].max():.0f}"
        line["replan_median_of_largest_ms"] = f"{1e3 * np.median(later):.0f}" if len(later) else ""
    return line


def flown_by_any(paths: list[Path]) -> int:
    """Return on how many maps of a row any policy succeeded: they can be flown."""
    flights = [np.load(path)["success_rate"].astype(bool) for path in paths]
    flown = np.zeros(max(len(each) for each in flights), bool)
    for each in flights:
        flown[: len(each)] |= each
    return int(flown.sum())


def write_table() -> None:
    """Write the table of all that has been flown."""
    lines = []
    for row in ROWS:
        paths = sorted(HERE.glob(f"{row}_*.npz"))
        lines += [summary(path) | {"maps_flown_by_any": str(flown_by_any(paths))} for path in paths]
    columns = list(dict.fromkeys(name for line in lines for name in line))
    with (DOCS / "data" / "navigate.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def write_page() -> None:
    """Write successes of four drones with their intervals into the page of the task."""
    with (DOCS / "data" / "navigate.csv").open(encoding="utf-8") as file:
        lines = [line for line in csv.DictReader(file) if line["drones"] == "4" and line["level"] in LEVELS]
    policies = sorted({line["policy"] for line in lines}, key=lambda name: (name != "mpc_route", name))
    rows = [f"|level|{'|'.join(f'`{policy}`' for policy in policies)}|", f"|---|{'---|' * len(policies)}"]
    for level in LEVELS:
        cells = {line["policy"]: line for line in lines if line["level"] == level}
        found = [cells.get(policy) for policy in policies]
        text = "{success_percent} of {maps} ({ci95})"
        rows.append(f"|{level}|{'|'.join(text.format(**line) if line else '-' for line in found)}|")
    page = DOCS / "navigate.md"
    before, rest = page.read_text(encoding="utf-8").split(BEGIN)
    page.write_text(f"{before}{BEGIN}" + "\n".join(rows) + f"\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Fly and write the table."""
    values = read_options(arguments, {"maps": 1000, "rows": ",".join(ROWS), "policies": "mpc_route"}, zero=["maps"])
    rows, policies = values["rows"].split(","), values["policies"].split(",")
    check_known("row", rows, ROWS)
    check_known("policy", policies, SCRIPTED)
    for row in rows:
        for policy in policies:
            fly(row, policy, values["maps"])
    write_table()
    write_page()


if __name__ == "__main__":
    run_script(main)
