"""`python -m multilift_marl.benchmark policy=hover suite=standard`, installed as `multilift-benchmark`."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

import multilift_marl as ml
from multilift_marl import plugins
from multilift_marl._files import write_whole
from multilift_marl._interrupt import ending_at_once, interrupted_by_signals
from multilift_marl._versions import find_versions
from multilift_marl.agents.policy import NamedPolicy, Script, find_policy, load_policy
from multilift_marl.cli.evaluate import fly
from multilift_marl.command import (
    CommandOptions,
    check_needs,
    join_command,
    limit_torch_threads,
    make_out,
    run_command,
    split_options,
)
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, reason
from multilift_marl.evaluation.metrics import compare, format_card, summarize
from multilift_marl.evaluation.parallel import Evaluation, cluster
from multilift_marl.evaluation.shortfalls import explain
from multilift_marl.evaluation.suites import BenchmarkTask, Suite, load_suite
from multilift_marl.schema.values import Between, Int
from multilift_marl.tasks import find_task

_USAGE = """Evaluate a policy on the fixed tasks and episodes of multilift-bench (docs/benchmark.md), beside the best
baseline and the shipped policy of each: a card with intervals, a table and a picture.

  python -m multilift_marl.benchmark policy=<name> [suite=standard|realistic|shifts] [episodes=N] [out=<folder>]

A trained policy brings the control, env.history and env.units that it was trained with, another one what is given here:
control.action=ctbr, say. All else is the suite's. Tasks that a policy cannot fly are listed with the reason."""
_SHIPPED = Path(ml.__file__).parent / "policies"
_BROUGHT = ("control", "env.history", "env.units")
_ADDED = ("versions", "sources"), ("policy", "sha256")
"""What cards of earlier versions may not say; a card that goes on from one does not say it either."""


class Options(CommandOptions):
    """Keys of the command beside those that a policy brings."""

    policy: str | None = Field(
        None, description="a shipped policy, a run, a file (.pt, .onnx), a baseline, or one's own class (module:Class)"
    )
    suite: Literal["standard", "realistic", "shifts"] = Field("standard", description="tasks that are flown")
    episodes: Annotated[Int | None, Between(1, 1e6)] = Field(
        None, description="of each task; None: as many as the suite asks for, fewer are a first look"
    )
    workers: Annotated[Int, Between(0, 1024)] = Field(0, description="processes of Ray that fly the episodes; 0: none")
    ray: str = Field("auto", description="cluster of these workers, as train.ray (docs/ray.md)")
    out: str | None = Field(
        None,
        description="folder for card.json, table.md and card.png, or that of a card to go on with; None: a new one",
    )


class _Contender(NamedTuple):
    """Who flies a task, and in what configuration."""

    name: str
    config: Config
    make: Callable[[MultiliftVec], Any]
    warning: str
    """What is to be known of that, see `TrainedPolicy.warning`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate; return the exit status."""
    run = partial(_benchmark, alone=arguments is None)
    return run_command(run, _USAGE, Options, arguments, configuration=None)


def _benchmark(values: dict[str, Any], alone: bool) -> int:
    import multilift_marl.evaluation.plots  # noqa: F401 (which needs matplotlib: before any work)

    options, given = split_options(Options, values)
    check_needs(options, {"ray": "workers=<number>"})
    with ending_at_once() if alone else nullcontext():
        suite = load_suite(options.suite)
        policy, brought = _find(options, given)
        episodes = options.episodes or suite.episodes
        name = str(options.policy)
        contenders, refused = _check(suite, name, policy, brought)
        label = policy.folder.name if policy.config and name == "latest" else Path(name.rpartition(":")[2]).stem
        out = make_out(options.out, Path("runs") / "benchmark", f"{label}-{suite.name}-")
        head = {
            "benchmark": suite.title,
            "suite": suite.name,
            "digest": suite.digest,
            "seed": suite.seed,
            "episodes": episodes,
            "versions": find_versions(),
            "policy": {"name": name, "sha256": _digest(_source(policy, name)), "brings": brought},
        }
        card = _begin(out / "card.json", head, refused)
    print(f"{card['benchmark']}, suite {suite.name}: {name}, {episodes} episodes of each task, into {out}")
    with interrupted_by_signals(), ExitStack() as stack:
        if options.workers:
            stack.enter_context(cluster(options.ray, options.workers))
            stack.enter_context(interrupted_by_signals())  # in place of Ray's handler
        try:
            for task in suite.tasks:
                if task.name not in card["tasks"]:
                    card["tasks"][task.name] = _fly(task, contenders[task.name], suite, episodes, options)
                    _write(out, card)
        except (KeyboardInterrupt, Exception) as error:  # a policy of one's own may raise anything
            done = sum("policies" in row for row in card["tasks"].values())
            _finish(out, suite, card)
            again = options.model_dump(include=options.model_fields_set) | {"episodes": episodes, "out": str(out)}
            command = join_command("python", "-m", "multilift_marl.benchmark", *_spell(again | given))
            print(f"stopped after {done} of {len(contenders)} tasks; go on by: {command}", file=sys.stderr)
            if isinstance(error, KeyboardInterrupt):
                return 130
            raise
        _finish(out, suite, card)
    return 0


def _spell(values: dict[str, Any]) -> list[str]:
    """Return values by key as arguments of the command."""
    return [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in values.items()]


def _find(options: Options, given: dict[str, Any]) -> tuple[NamedPolicy, dict[str, Any]]:
    """Return the policy, and the configuration values that it brings."""
    if options.policy is None:
        raise ConfigError("which policy? give policy=<shipped policy, run, file, baseline or module:Class>")
    given = {key: value for key, value in given.items() if key != "import"}
    for key in given:
        if key.partition(".")[0] != "control" and key not in _BROUGHT:
            raise ConfigError(
                f"the tasks of multilift-bench are fixed: leave out {key}; a policy may bring control.<key>, "
                "env.history and env.units alone"
            )
    policy = find_policy(options.policy)
    load_config("hover", given)  # refuses what no task could take
    return policy, _brought(policy) | given


def _brought(policy: NamedPolicy) -> dict[str, Any]:
    if policy.config is None:
        return {}
    config = policy.config.model_dump(mode="json")
    return {"control": config["control"], **{f"env.{key}": config["env"][key] for key in ("history", "units")}}


def _check(
    suite: Suite, name: str, policy: NamedPolicy, brought: dict[str, Any]
) -> tuple[dict[str, dict[str, _Contender]], dict[str, str]]:
    """Return who flies which task, and why the policy cannot fly the others."""
    limit_torch_threads()
    contenders, refused = {}, {}
    for task in suite.tasks:
        try:
            config = _configure(task, brought)
            policy.check(config, "policy")
            probe = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}))
            if not (why := policy.misfit(probe)):
                policy.bind(probe)
        except ConfigError as error:
            why = str(error)
        if why:
            refused[task.name] = why
            continue
        teams = {"policy": _Contender(name, config, policy.bind, policy.warning(config))}
        if task.baseline != name:
            teams["baseline"] = _Contender(task.baseline, _configure(task, {}), Script(task.baseline).bind, "")
        weights = None if task.shipped is None else _SHIPPED / f"{task.shipped}.pt"
        if weights is not None and _digest(weights) != _digest(_source(policy, name)):
            shipped = load_policy(weights)
            config = _configure(task, _brought(shipped))
            shipped.check(config)
            teams["shipped"] = _Contender(str(task.shipped), config, shipped.bind, shipped.warning(config))
        contenders[task.name] = teams
    if not contenders:
        first, why = next(iter(refused.items()))
        same = policy.config is None and len(set(refused.values())) == 1  # one's own class is missing, say
        raise ConfigError(why if same else f"{name} can fly no task of suite={suite.name}; {first}: {why}")
    return contenders, refused


def _configure(task: BenchmarkTask, brought: dict[str, Any]) -> Config:
    return build_config(task.config.model_dump(), {"env.num_threads": 0} | brought)


def _source(policy: NamedPolicy, name: str) -> Path | None:
    """Return the file of a policy: its weights, or the module of a class of one's own, which is imported already."""
    if policy.config is not None:
        return Path(policy.source)
    if ":" not in name:
        return None
    module, _ = plugins.import_module(name.rpartition(":")[0], "policy")
    file = getattr(module, "__file__", None)
    return None if file is None else Path(file)


def _digest(path: Path | None) -> str | None:
    return None if path is None or not path.is_file() else hashlib.sha256(path.read_bytes()).hexdigest()


def _begin(path: Path, head: dict[str, Any], refused: dict[str, str]) -> dict[str, Any]:
    """Return a card with the rows that the file has already, if it is of the same evaluation."""
    tasks: dict[str, Any] = {name: {"not_applicable": why} for name, why in refused.items()}
    if not path.exists():
        return head | {"complete": False, "tasks": tasks}
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        found = {key: known[key] for key in head}
        unknown = [(part, key) for part, key in _ADDED if found[part].get(key) is None and head[part][key] is not None]
        tasks |= {name: row for name, row in known["tasks"].items() if "policies" in row}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} is no card to go on with ({reason(error)}); give another folder by out=") from error
    for part, key in unknown:
        found[part] |= {key: None}
        head = head | {part: head[part] | {key: None}}
    for key, value in json.loads(json.dumps(head)).items():
        if found[key] != value:
            raise ConfigError(f"{path} is of another evaluation, its {key} differs; give another folder by out=")
    for part, key in unknown:
        print(f"note: {path} does not say {key} of {part}, so its rows may be of other code; out=<folder> begins anew")
    return head | {"complete": False, "tasks": tasks}


def _fly(
    task: BenchmarkTask, teams: dict[str, _Contender], suite: Suite, episodes: int, options: Options
) -> dict[str, Any]:  # fmt: skip
    """Return the row of a task."""
    evaluation = Evaluation(episodes, suite.seed, options.workers, task.factors)
    flown = {
        label: fly(team.config, team.make, f"{task.name}: {team.name}", evaluation) for label, team in teams.items()
    }
    causes = find_task(task.config.task).causes()
    return {
        **task.definition(),
        "policies": {
            label: {
                "name": teams[label].name,
                **({"warning": warning} if (warning := teams[label].warning) else {}),
                "metrics": summarize(each, causes),
                "unsuccessful": explain(each, causes),
            }
            for label, each in flown.items()
        },
        "paired": {label: compare(flown["policy"], each) for label, each in flown.items() if label != "policy"},
    }


def _write(out: Path, card: dict[str, Any]) -> None:
    text = json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False)
    write_whole(out / "card.json", f"{text}\n".encode())


def _finish(out: Path, suite: Suite, card: dict[str, Any]) -> None:
    """Write and print what has been flown, tasks in the suite's order."""
    from multilift_marl.evaluation.plots import plot_card

    card["tasks"] = {task.name: card["tasks"][task.name] for task in suite.tasks if task.name in card["tasks"]}
    card["complete"] = len(card["tasks"]) == len(suite.tasks) and card["episodes"] >= suite.episodes
    _write(out, card)
    table = format_card(card)
    (out / "table.md").write_text(table, encoding="utf-8")
    plot_card(out / "card.png", card)
    print(f"\n{table}\nwrote card.json, table.md and card.png in {out}")


if __name__ == "__main__":
    sys.exit(main())
