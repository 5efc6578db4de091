"""Cards of the policies that come with the package: what they were trained on, what they do, where they fail.

    python results/model_cards.py

writes docs/models.md from the policies, their recipes and the recorded results.
"""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import fill
from typing import Any

from flights import FLIGHTS, HERE, ROOT
from tables import best_script, details, gain, learned_teams, shifts

from multilift_marl.agents.policy import LearnedPolicy, load_policy
from multilift_marl.config.config import Config

PAGE = ROOT / "docs" / "models.md"
FROM_NOTHING = (
    "Changes that it did not see in training are in [learning.md](learning.md#from-nothing); **where actions come one "
    "step (20 ms) late it holds {late} of 50 payloads**."
)
ELSEWHERE = {
    "hover_acc_rates": FROM_NOTHING.format(late="2 %"),
    "hover_ctbr": FROM_NOTHING.format(late="12 %"),
    "hover_ctbm": FROM_NOTHING.format(late="none"),
    "hover_rotor": FROM_NOTHING.format(late="none"),
}
"""What policies without a table of shifts do under changes."""
POLICIES = ROOT / "multilift_marl" / "policies"
HEAD = """# Policies that come with the package

One card for each policy of `ml.load_policy(<name>)`, written by `python results/model_cards.py` from the policies,
their recipes `configs/<name>.yaml` and the recorded results. Weights are those of training seed 0. Rates and errors are
means and 95 % intervals over the episodes of seed 1000, in the simulation that the policies were trained in; none has
flown a real drone. Errors are of all episodes, and of those that succeed alone. The vehicles are in
[vehicles.md](vehicles.md), tasks in [tasks.md](tasks.md), licences in [NOTICE](../NOTICE).

Environments with other observations or actions are refused. What a policy does with other rigs, numbers of drones or
conditions than those of its recipe is known only where its card says so.
"""


def card(name: str) -> str:
    """Return the card of a policy."""
    policy = load_policy(name)
    assert isinstance(policy, LearnedPolicy)
    parts = [f"## {name}", _training(name, policy), _conditions(policy.config)]
    flights = [flight for flight, entry in FLIGHTS.items() if entry.recipe == name]
    for flight in flights:
        if learned_teams(flight):
            best = best_script(flight)
            parts.append(
                f"{FLIGHTS[flight].title}, {_episodes(flight)} episodes; learned less best script: "
                f"{gain(flight).replace(f', {best}', f', `{best}`')}."
            )
            parts += [_teams(flight, best), _limits(flight)]
    tested = [flight for flight in flights if (HERE / flight / "shifts.json").is_file()]
    if tested:
        parts += [
            "Each change alone, hidden from the drones; what was random in training is above:",
            shifts(tested),
        ]
    else:
        parts.append(ELSEWHERE.get(name, "Not recorded: what it does under changes that it did not see in training."))
    return "\n\n".join(parts)


def _teams(flight: str, best: str) -> str:
    """Return the rows of the learned teams and of the best script."""
    kept = ("| | ", "|---", f"| {best} |", "| learned, ")
    return "\n".join(line for line in details([flight]).splitlines() if line.startswith(kept))


def _limits(flight: str) -> str:
    """Return how often the learned team of seed 0 does not succeed."""
    found = json.loads((HERE / flight / "seed0.json").read_text(encoding="utf-8"))["metrics"]
    rate = found["success_rate"]
    low, high = (100 * (1 - bound) for bound in reversed(rate["ci95"]))
    return f"The shipped policy does not succeed in {100 * (1 - rate['mean']):.1f} ({low:.1f} - {high:.1f}) %."


def _training(name: str, policy: LearnedPolicy) -> str:
    """Return what the policy was trained on, as a table."""
    config, train = policy.config, policy.config.train
    recorded = HERE / name / "seed0" / "training.json"
    minutes = f", {json.loads(recorded.read_text(encoding='utf-8'))['minutes']:g} minutes" if recorded.is_file() else ""
    frames = json.loads(recorded.read_text(encoding="utf-8"))["frames"] if recorded.is_file() else policy.frames
    seeds = sorted(path.name.removeprefix("seed") for path in (HERE / name).glob("seed?") if path.is_dir())
    start = f"`{train.residual}`" if train.residual else "nothing"
    if train.residual == "formation" and config.control.action != "reference":
        start = "zero actions"  # what `formation` is with these
    gru = f", GRU of {train.gru}" if train.gru else ""
    fine = f", inputs also on a fine scale (`train.asinh={train.asinh:g}`)" if train.asinh else ""
    overrides = ", ".join(f"`{key}={value}`" for key, value in sorted(train.overrides.items()))
    rows = {
        "task": f"`{config.task}`, {_drones(config)}, episodes of {config.env.episode_seconds:g} s",
        "actions": f"`{config.control.action}` ({len(policy.action_names)} of each drone)",
        "observation": f"{len(policy.observation_names)} numbers of each drone, `env.sensing={config.env.sensing}`",
        "trained by": f"{train.algorithm}, {frames:,} environment steps{minutes}",
        "best policy": f"after {policy.frames:,} environment steps" if policy.frames else "the untrained one",
        "training seeds recorded": f"{len(seeds)} ({', '.join(seeds)})" if seeds else "-",
        "starts from": start,
        "network": f"`{train.actor}`, {' × '.join(map(str, train.hidden))}{gru}{fine}",
        "environment of training alone": overrides or "as evaluated",
        "command": f"`python train.py config={name}`",
    }
    return "| | |\n|---|---|\n" + "\n".join(f"| {key} | {value} |" for key, value in rows.items())


def _drones(config: Config) -> str:
    """Return how many drones the policy was trained with, of all its rigs."""
    counts = {rig.get("env.num_drones", config.env.num_drones) for rig in config.train.rigs}
    if not counts:
        return f"{config.env.num_drones} drones"
    return f"{len(config.train.rigs)} rigs of {min(counts)} to {max(counts)} drones"


def _conditions(config: Config) -> str:
    """Return what of the conditions differs from the defaults."""
    usual = Config(task=config.task)
    found = []
    for section in ("randomization", "wind", "vehicle", "cable", "payload"):
        mine, its = (getattr(each, section).model_dump(mode="json") for each in (config, usual))
        found += [f"`{section}.{key}={_short(value)}`" for key, value in mine.items() if value != its[key]]
    return f"Conditions other than the defaults: {', '.join(found) if found else 'none'}."


def _short(value: Any) -> str:
    text = json.dumps(value) if isinstance(value, list) else str(value)
    return text if len(text) < 60 else f"{text[:56]}..."


def _episodes(flight: str) -> int:
    team = learned_teams(flight)[0]
    count: int = json.loads((HERE / flight / f"{team}.json").read_text(encoding="utf-8"))["episodes"]
    return count


def page() -> str:
    """Return docs/models.md."""
    names = sorted(path.stem for path in POLICIES.glob("*.pt"))
    index = fill(" · ".join(f"[{name}](#{name})" for name in names), 120, break_on_hyphens=False)
    return "\n\n".join([HEAD.strip(), index, *map(card, names)]) + "\n"


def main(path: Path = PAGE) -> None:
    """Write the page."""
    path.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
