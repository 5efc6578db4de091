"""`python evaluate.py run=latest`, installed as `multilift-evaluate`."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.cli.common import make_folder, run_command, title, whole_number
from multilift_marl.cli.policies import find_policy
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.control.scripted import fitting_scripts
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, RenderingError, nearest
from multilift_marl.evaluation.report import format_table, make_report, write_report
from multilift_marl.evaluation.rollout import fly_episodes, trace_episode
from multilift_marl.rendering import CAMERAS

_USAGE = """Judge a team on fixed seeds, beside the scripted ones on the same episodes.

  python evaluate.py run=latest episodes=200 seed=1000 baseline=formation_integral video=true [key=value ...]
  python evaluate.py policy=formation config=pose_easy baseline=payload_geometric [key=value ...]

  run         a run folder, its name, "latest", or the name of a shipped policy ("hover")     (latest)
  policy      in place of a run: a script (formation, formation_integral, formation_feedback, formation_gusts,
              formation_lead, formation_narrow, formation_redistributed, payload_geometric), one's own class
              (module:Class, file.py:Class), an exported policy (.onnx), a checkpoint (.pt)   (none)
  config      environment of that policy, a configuration's name or path; task=<other> keeps its vehicles, payload,
              cables and control, see python train.py --help            (what it was trained in, of scripts hover)
  import      a module of one's own with tasks or vehicles (docs/plugins.md)                  (as the run)
  checkpoint  best, last, or a file                                                           (best)
  episodes    how many                                                                        (200)
  seed        evaluation seed: episode i is the same for every policy                         (1000)
  baseline    drawn beside the policy, named like it, or a run folder or shipped policy; none: fly the policy alone
                                                                                              (formation_integral)
  video       true: also an mp4 of the first episode                                          (false)
  camera      of the video: side, top or chase                                                (side)
  trail       seconds of flight that drones and payload draw behind them in the video         (2)
  out         folder for metrics.json, plots and video      (<run>/eval/<time>, of a script runs/<policy>-<config>/…)

Any configuration key changes the environment: env.num_drones=6, payload.mass=1.7, randomization.payload_force=0."""

_DEFAULTS = {
    "run": "latest", "policy": None, "config": None, "checkpoint": "best", "episodes": 200, "seed": 1000,
    "baseline": "formation_integral", "video": False, "camera": "side", "trail": 2.0, "out": None,
}  # fmt: skip

_NAMES = ("run", "policy", "config", "checkpoint", "baseline", "camera", "out")


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate; return the exit status."""
    return run_command(_evaluate, _USAGE, _DEFAULTS, arguments, names=_NAMES)


def _evaluate(values: dict[str, Any]) -> int:
    _check_source(values)
    own = {key: values.pop(key, default) for key, default in _DEFAULTS.items()}
    _check(own)
    own["baseline"] = str(own["baseline"])
    baseline = find_policy(own["baseline"], "baseline", ["none"]) if own["baseline"] != "none" else None
    flown = _find_run(own) if own["policy"] is None else _find_named(own, values)
    config = build_config(flown.config.model_dump(), {"env.num_threads": 0} | values)
    _ = config.system
    probe = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}))
    makers = {flown.name: flown.make}
    if baseline is not None:
        makers |= {name: find_policy(name).bind for name in fitting_scripts(probe) if name != flown.name}
        makers.setdefault(own["baseline"], baseline.bind)
    for make in makers.values():  # refuses what does not fit, before there is a folder
        make(probe)
    out = make_folder(Path(own["out"]) if own["out"] else flown.folder / "eval" / time.strftime("%Y%m%d-%H%M%S"))

    order = sorted(makers, key=lambda name: ":" not in name)  # one's own first: should they fail, nothing is lost
    episodes = {name: _fly(config, makers[name], name, own) for name in order}
    judged = episodes.pop(flown.name)
    report = make_report(config, own["seed"], judged, episodes)
    print(f"\n{flown.source}: {own['episodes']} episodes, seed {own['seed']}; mean (95 % interval)\n")
    print(format_table(report, flown.name))
    write_report(out / "metrics.json", report)
    print(f"\nwrote {out / 'metrics.json'}")
    _draw(config, makers, flown, own, out)
    return 0


class _Flown(NamedTuple):
    """What is judged."""

    name: str
    """Of its column: "policy" for a learned one, else the script's."""
    source: str
    config: Config
    make: Callable[[MultiliftVec], Any]
    folder: Path
    """That its evaluations belong to."""


def _check_source(values: dict[str, Any]) -> None:
    """Refuse keys of a run beside another policy, and the other way round."""
    named = values.get("policy") is not None
    wrong = [key for key in (("run", "checkpoint") if named else ("config",)) if key in values]
    if wrong and named:
        raise ConfigError(f"policy={values['policy']} takes the place of a run and has no {wrong[0]}; leave out one")
    if wrong:
        raise ConfigError("a run brings its own configuration: leave out config, or fly a script by policy=formation")


def _find_named(own: dict[str, Any], values: dict[str, Any]) -> _Flown:
    name = str(own["policy"])
    policy = find_policy(name)
    if policy.config is None or own["config"] is not None:
        config = load_config(str(own["config"] or "hover"), values)
        where = title(values | {"config": own["config"]})
    else:
        config, where = policy.config, policy.config.task
    module, _, kind = name.rpartition(":")
    label = f"{Path(module).name.removesuffix('.py')}.{kind}" if module else Path(name).stem
    return _Flown(name, f"{name} on {where}", config, policy.bind, Path("runs") / f"{label}-{where}")


def _check(own: dict[str, Any]) -> None:
    own["episodes"] = whole_number("episodes", own["episodes"], 1, 1_000_000)
    own["seed"] = whole_number("seed", own["seed"], 0)
    if not isinstance(own["video"], bool):
        raise ConfigError(f"video must be true or false, but is {own['video']!r}")
    if own["camera"] not in CAMERAS:
        raise ConfigError(f"unknown camera '{own['camera']}'{nearest(str(own['camera']), CAMERAS)}")
    if isinstance(own["trail"], bool) or not isinstance(own["trail"], int | float) or not 0 <= own["trail"] < 1e3:
        raise ConfigError(f"trail must be a number of seconds from 0 to 1000, but is {own['trail']!r}")


def _find_run(own: dict[str, Any]) -> _Flown:
    run, checkpoint = str(own["run"]), str(own["checkpoint"])
    import torch

    from multilift_marl.agents.checkpoint import find_run
    from multilift_marl.agents.policy import load_policy, shipped_policies

    torch.set_num_threads(1)  # for networks this small, more of them only wait for each other
    if run in shipped_policies() and not os.path.exists(run):
        if checkpoint != "best":
            raise ConfigError(f"checkpoint={checkpoint} means nothing to the shipped policy '{run}'; leave it out")
        policy, folder = load_policy(run), Path("runs") / f"shipped-{run}"
    else:
        folder = find_run(run)
        file = folder / "checkpoints" / f"{checkpoint}.pt" if checkpoint in ("best", "last") else Path(checkpoint)
        policy = load_policy(folder if checkpoint == "best" else file)
    return _Flown("policy", policy.source, policy.config, policy.bind, folder)


def _fly(config: Config, maker: Any, name: str, own: dict[str, Any]) -> dict[str, np.ndarray]:
    from tqdm import tqdm

    with tqdm(total=own["episodes"], desc=name, unit="episode", leave=False) as bar:
        return fly_episodes(config, maker, own["episodes"], own["seed"], progress=lambda n: bar.update(n - bar.n))


def _draw(config: Config, makers: dict[str, Any], flown: _Flown, own: dict[str, Any], out: Path) -> None:
    """Plot the first episode of policy and baseline, and the training; film the policy if asked."""
    from multilift_marl.evaluation import plots

    names = dict.fromkeys([flown.name] + ([] if own["baseline"] == "none" else [own["baseline"]]))
    traces = {name: trace_episode(config, makers[name], 0, own["seed"]) for name in names}
    plots.plot_errors(out / "errors.png", traces)
    plots.plot_tensions(out / "tensions.png", traces[flown.name], f"{flown.name}, episode 0")
    plots.plot_paths(out / "paths.png", traces[flown.name], f"{flown.name}, episode 0")
    if own["policy"] is None:
        from multilift_marl.agents.logging import read_metrics

        if rows := read_metrics(flown.folder):
            plots.plot_training(out / "training.png", rows)
    print(f"wrote plots in {out}")
    if own["video"]:
        try:
            _film(config, flown.make, own, out / "episode_0.mp4")
        except RenderingError as error:
            print(f"no video: {error}", file=sys.stderr)


def _film(config: Config, maker: Any, own: dict[str, Any], path: Path) -> None:
    """Film the first episode, every other policy step."""
    from tqdm import tqdm

    from multilift_marl import rendering

    tools: list[Any] = []  # made with the first frame, so that no empty file is left where there is no OpenGL
    with ExitStack() as stack:
        steps = round(config.env.episode_seconds * config.env.policy_hz)
        bar = stack.enter_context(tqdm(total=steps // 2, desc="filming", unit="frame", leave=False))

        def shoot(vec: Any) -> None:
            if not tools:
                tools.append(stack.enter_context(rendering.Renderer(vec, camera=own["camera"], trail=own["trail"])))
                tools.append(stack.enter_context(rendering.VideoWriter(path, config.env.policy_hz / 2)))
            renderer, video = tools
            if vec.steps[0] % 2 == 0:
                video.append(renderer.frame())
                bar.update()

        trace_episode(config, maker, 0, own["seed"], shoot)
    print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
