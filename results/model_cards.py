"""Cards of the policies that come with the package: what they were trained on, what they do, where they fail.

    python results/model_cards.py

writes docs/models.md, a table, and docs/models/<name>.json, a card for each policy, from the policies, their recipes
and the recorded results.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from flights import FLIGHTS, HERE, ROOT, error_metric
from tables import best_baseline, compare, learned_policies, title

from multilift_marl.agents.policy import LearnedPolicy, load_policy
from multilift_marl.config.config import Config

PAGE = ROOT / "docs" / "models.md"
POLICIES = ROOT / "multilift_marl" / "policies"
_UNSEEN = (
    "six drones",
    "three drones, payload of 0.9 kg",
    "standard observation noise",
    "actions one step (20 ms) late",
)
NO_BASE_POLICY = {  # success [%] and error [cm] over 50 episodes each
    "hover_acc_rates": ((100, 0.36), (94, 1.1), (100, 1.3), (2, None)),
    "hover_ctbr": ((100, 0.30), (98, 0.70), (100, 0.68), (12, 1.4)),
    "hover_ctbm": ((100, 0.36), (100, 1.2), (100, 1.4), (0, None)),
    "hover_rotor": ((100, 0.57), (98, 1.7), (100, 1.7), (0, None)),
}
"""What policies that were trained without a base policy do under `_UNSEEN` shifts."""
SIMULATED = "Trained and evaluated in this simulation alone; not flown on a real drone."
REFUSED = "Environments with other observations or another action interface are refused."
HEAD = """# Shipped policies

The policies of `ml.load_policy(<name>)`, and how each compares with the best baseline. Names link to cards (JSON):
observations and normalisation, recipe, seeds, metrics as [mean, low, high] of the 95 % interval, robustness to shifts,
limits.

```bash
python evaluate.py run=hover episodes=200 seed=1000  # evaluate a policy; the others by their names
python train.py config=hover                         # train it again
```

- Weights are of training seed 0, verdicts of all recorded seeds, as in [results.md](results.md), where the gains are;
  training is environment steps and minutes, of a machine that did other work too.
- Performance on real drones is unknown, on other rigs, numbers of drones or conditions known only
  where `shifts` of the card state it.
- Environments with other observations or another [action interface](control.md#action-interfaces) are refused.
- Weights are licensed under Apache-2.0 ([NOTICE](../NOTICE)).
"""


def card(name: str) -> dict[str, Any]:
    """Return the card of a policy."""
    policy = load_policy(name)
    assert isinstance(policy, LearnedPolicy)
    config, weights = policy.config, POLICIES / f"{name}.pt"
    flights = [flight for flight, entry in FLIGHTS.items() if entry.recipe == name]
    return {
        "name": name,
        "weights": {
            "file": weights.relative_to(ROOT).as_posix(),
            "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
            "licence": "Apache-2.0",
        },
        "task": config.task,
        "num_drones": config.env.num_drones,
        "episode_seconds": config.env.episode_seconds,
        "policy_hz": config.env.policy_hz,
        "conditions_other_than_defaults": _conditions(config),
        "actions": {
            "interface": config.control.action,
            "names": policy.action_names,
            "control": _differences(config.control, Config(task=config.task).control),
        },
        "observations": _observations(policy),
        "training": _training(name, policy),
        "evaluation": [_evaluation(flight) for flight in flights if learned_policies(flight)],
        "shifts": _shifts(name),
        "limits": _limits(name),
        "commands": {
            "train": f"python train.py config={name}",
            "evaluate": f"python evaluate.py run={name} episodes=1000 seed=1000",
        },
    }


def _observations(policy: LearnedPolicy) -> dict[str, Any]:
    """Return what each drone observes, in order, and how it is normalised."""
    config, normalizer = policy.config, policy.actor.normalizer
    components: dict[str, int] = {}
    newest = policy.observation_names[: len(policy.observation_names) // len(config.env.ages)]
    for each in newest:
        component = each.rpartition("_")[0]
        components[component] = components.get(component, 0) + 1
    scaled = f"standardised by running statistics of training, within ±{normalizer.clip:g} standard deviations"
    if normalizer.asinh:
        scaled += f"; beside each number asinh({normalizer.asinh:g} x / std) / asinh({normalizer.asinh:g})"
    return {
        "size": len(policy.observation_names),
        "components": components,
        "history": config.env.history,
        "sensing": config.env.sensing,
        "normalisation": f"{scaled}; part of the network",
    }


def _training(name: str, policy: LearnedPolicy) -> dict[str, Any]:
    """Return what the policy was trained on."""
    train, recorded = policy.config.train, HERE / name / "seed0" / "training.json"
    duration = json.loads(recorded.read_text(encoding="utf-8")) if recorded.is_file() else {}
    base = train.residual or None
    if base == "formation" and policy.config.control.action != "reference":
        base = None  # zero actions, with these
    return {
        "recipe": f"configs/{name}.yaml",
        "algorithm": train.algorithm,
        "environment_steps": duration.get("frames", policy.frames),
        "minutes": duration.get("minutes"),
        "best_policy_after_steps": policy.frames,
        "seeds": [int(path.name.removeprefix("seed")) for path in _seeds(name)],
        "base_policy": base,
        "network": {
            "actor": train.actor, "hidden": train.hidden, "gru": train.gru, "asinh": train.asinh,
        },
        "only_in_training": train.overrides,
        "rigs": train.rigs,
    }  # fmt: skip


def _seeds(name: str) -> list[Path]:
    return sorted(path for path in (HERE / name).glob("seed?") if path.is_dir())


def _evaluation(flight: str) -> dict[str, Any]:
    """Return the recorded metrics of the learned policies and of the best baseline of a flight."""
    best, learned = best_baseline(flight), learned_policies(flight)
    reports = {name: json.loads((HERE / flight / f"{name}.json").read_text(encoding="utf-8")) for name in learned}
    gain, verdict = compare(flight) or ("-", "-")
    found = {
        "flight": flight,
        "conditions": FLIGHTS[flight].title,
        "config": FLIGHTS[flight].config,
        "overrides": FLIGHTS[flight].overrides,
        "episodes": reports[learned[0]]["episodes"],
        "seed": reports[learned[0]]["seed"],
        "compared_by": error_metric(FLIGHTS[flight]),
        "gain": gain,
        "verdict": verdict,
        "best_baseline": title(best).strip("`") if best else None,
        "metrics": {name: _short(report["metrics"]) for name, report in reports.items()},
    }
    if best:
        baseline = json.loads((HERE / flight / f"{best}.json").read_text(encoding="utf-8"))
        found["metrics"]["best_baseline"] = _short(baseline["metrics"])
    return found


def _short(metrics: dict[str, Any]) -> dict[str, list[float]]:
    """Return [mean, low, high] of each metric, [mean] of too few episodes."""
    return {
        name: [float(f"{value:.6g}") for value in (each["mean"], *(each["ci95"] or ()))]
        for name, each in metrics.items()
    }


def _shifts(name: str) -> dict[str, Any]:
    """Return success, error [m] and attitude error [deg] of a policy and the best baseline under each shift alone."""
    found: dict[str, Any] = {}
    if name in NO_BASE_POLICY:
        rows = [
            {
                "shift": shift,
                "learned": {"success": success / 100, "error": None if error is None else round(error / 100, 6)},
            }
            for shift, (success, error) in zip(_UNSEEN, NO_BASE_POLICY[name], strict=True)
        ]
        found[name] = {"episodes": 50, "rows": rows}
    for flight, entry in FLIGHTS.items():
        path = HERE / flight / "shifts.json"
        if entry.recipe == name and path.is_file():
            found[flight] = json.loads(path.read_text(encoding="utf-8"))
            for each in (each for row in found[flight]["rows"] for each in row.values() if isinstance(each, dict)):
                each |= {key: float(f"{value:.6g}") for key, value in each.items() if key != "refused"}
    return found


def _limits(name: str) -> list[str]:
    """Return where the policy fails, or what is not known."""
    limits = []
    for flight, entry in FLIGHTS.items():
        if entry.recipe == name and (path := HERE / flight / "seed0.json").is_file():
            rate = json.loads(path.read_text(encoding="utf-8"))["metrics"]["success_rate"]
            low, high = (100 * (1 - bound) for bound in reversed(rate["ci95"]))
            failing = f"failure rate {100 * (1 - rate['mean']):.1f} % (95 % interval {low:.1f} to {high:.1f})"
            limits.append(f"{entry.title}: {failing}.")
    if not _shifts(name):
        limits.append("Not evaluated under shifts that it did not see in training.")
    if name in NO_BASE_POLICY:
        limits.append("Fails with one step (20 ms) of action delay, see shifts.")
    return [*limits, SIMULATED, REFUSED]


def _conditions(config: Config) -> dict[str, Any]:
    """Return what of the conditions differs from the defaults."""
    usual, found = Config(task=config.task), dict[str, Any]()
    for section in ("randomization", "wind", "vehicle", "cable", "payload"):
        differing = _differences(getattr(config, section), getattr(usual, section))
        found |= {f"{section}.{key}": value for key, value in differing.items()}
    return found


def _differences(section: Any, usual: Any) -> dict[str, Any]:
    mine, its = section.model_dump(mode="json"), usual.model_dump(mode="json")
    return {key: value for key, value in mine.items() if value != its[key]}


def page(cards: list[dict[str, Any]]) -> str:
    """Return docs/models.md."""
    lines = ["| policy | task and conditions | drones | actions | training | verdict |"]
    lines.append("|" + "---|" * 6)
    for each in cards:
        training = each["training"]
        counts = {rig.get("env.num_drones", each["num_drones"]) for rig in training["rigs"]} or {each["num_drones"]}
        drones = str(min(counts)) if len(counts) == 1 else f"{min(counts)}–{max(counts)}"
        minutes = "" if training["minutes"] is None else f", {training['minutes']:.0f} min"
        task = f"[{each['task']}](results.md#{each['task']})"
        rows = [[row["conditions"], row["verdict"]] for row in each["evaluation"]] or [["", "-"]]
        titles, verdicts = (list(column) for column in zip(*rows, strict=True))
        titles = ["" if text == each["task"] else text.removeprefix(f"{each['task']}, ") for text in titles]
        steps = f"{training['environment_steps'] / 1e6:.1f} M steps{minutes}"
        cells = [f"[{each['name']}](models/{each['name']}.json)", "<br>".join(filter(None, [task, *titles]))]
        cells += [drones, f"`{each['actions']['interface']}`", steps, "<br>".join(verdicts)]
        if len(titles) > 1:
            cells[-1] = f"<br>{cells[-1]}"
        lines.append(f"| {' | '.join(cells)} |")
    return f"{HEAD}\n" + "\n".join(lines) + "\n"


def write(each: dict[str, Any]) -> str:
    """Return the text of a card, lists of numbers and names in a line each."""
    text = json.dumps(each, indent=1, ensure_ascii=False)
    flat = re.compile(r"\[\s+([^][{}]*?)\s+\]")
    return flat.sub(lambda found: "[" + re.sub(r",\s+", ", ", found[1]) + "]", text) + "\n"


def names() -> list[str]:
    """Return the names of the shipped policies."""
    return sorted(path.stem for path in POLICIES.glob("*.pt"))


def main(path: Path = PAGE) -> None:
    """Write the page and the cards."""
    cards = [card(name) for name in names()]
    path.write_text(page(cards), encoding="utf-8")
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    for each in cards:
        (folder / f"{each['name']}.json").write_text(write(each), encoding="utf-8")


if __name__ == "__main__":
    main()
