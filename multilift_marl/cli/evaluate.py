"""`python evaluate.py run=latest`, installed as `multilift-evaluate`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl._interrupt import ending_at_once, interrupted_by_signals
from multilift_marl.agents.policy import NamedPolicy, find_policy, load_policy, shipped_policies
from multilift_marl.command import (
    UNTRAINED,
    CommandOptions,
    check_needs,
    limit_torch_threads,
    make_out,
    run_command,
    spell_command,
    split_options,
    title,
)
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, choose_config, list_configs, load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, RenderingError
from multilift_marl.evaluation.metrics import format_reasons, format_table, make_report, write_report
from multilift_marl.evaluation.parallel import Evaluation, cluster, evaluate_parallel
from multilift_marl.evaluation.rollout import Trace, run_episodes, trace_episode
from multilift_marl.evaluation.trajectories import TrajectoryWriter
from multilift_marl.policies.baselines import SCRIPTED, fitting_scripts
from multilift_marl.schema.values import Between, Float, Int

_USAGE = """Evaluate a team on fixed seeds, beside the baselines on the same episodes.

  python evaluate.py run=latest episodes=200 seed=1000 baseline=formation_integral video=true [key=value ...]
  python evaluate.py run=hover config=rigs/falcon3 [key=value ...]
  python evaluate.py policy=formation config=pose_easy baseline=payload_geometric [key=value ...]

Baselines are formation, formation_integral, formation_feedback, formation_gusts, formation_lead, formation_narrow,
formation_redistributed and payload_geometric; hold_velocity, hold_acceleration, hold_acc_rates, hold_full_state,
hold_ctbr, hold_ctbm and hold_rotor with these action interfaces. task=<other> keeps the configuration's vehicles,
payload, cables and control, see python train.py --help.
Any configuration key changes the environment: env.num_drones=6, payload.mass=1.7, randomization.payload_force=0."""


_NEEDS = {
    "camera": "video=true", "trail": "video=true", "names": "bag=<folder>", "ros": "bag=<folder>",
    "ray": "workers=<number>",
}  # fmt: skip
"""What keys of the command mean nothing without."""


class Options(CommandOptions):
    """Keys of the command beside those of the configuration."""

    run: str = Field("latest", description='a run folder, its name, "latest", or a shipped policy ("hover")')
    policy: str | None = Field(
        None, description="in place of a run: a baseline, one's own class (module:Class, file.py:Class), .onnx, .pt"
    )
    config: str | None = Field(
        None, description="environment to fly in, name or path; None: what it was trained in, of baselines hover"
    )
    checkpoint: str = Field("best", description="of the run: best, last, or a file")
    episodes: Annotated[Int, Between(1, 1e6)] = Field(200, description="how many")
    seed: Int = Field(1000, ge=0, description="evaluation seed: episode i is the same for every policy")
    baseline: str | None = Field(
        None,
        description="drawn beside the policy, named like it, or a run; none: the policy alone; None: the one that fits",
    )
    video: bool = Field(False, description="also an mp4 of the first episode")
    plots: Literal["png", "pdf"] = Field("png", description="of plots; pdf: both, for papers")
    camera: Literal["side", "top", "chase"] = Field("side", description="of the video")
    trail: Annotated[Float, Between(0, 1000, "s")] = Field(
        2.0, description="[s] of the paths that the video draws behind drones and payload"
    )
    bag: str | None = Field(None, description="folder of a ROS 2 bag of the first episode, see docs/ros.md")
    ros: Literal["humble", "jazzy", "kilted", "lyrical"] = Field("jazzy", description="distribution of that bag")
    names: Literal["multilift", "report", "crazyswarm2"] = Field(
        "multilift", description="of its topics: ours, the report's or Crazyswarm2's"
    )
    trajectories: bool = Field(
        False, description="also states, actions, rotor thrusts, references and tensions of all episodes, in out"
    )
    workers: Annotated[Int, Between(0, 1024)] = Field(0, description="processes of Ray that fly the episodes; 0: none")
    ray: str = Field("auto", description="cluster of these workers, as train.ray (docs/ray.md)")
    out: str | None = Field(
        None, description="folder for metrics.json, plots and video; None: <run>/eval/<time>, of a baseline runs/..."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate; return the exit status."""
    return run_command(partial(_evaluate, alone=arguments is None), _USAGE, Options, arguments)


def _evaluate(values: dict[str, Any], alone: bool) -> int:
    """Evaluate; `alone` says whether this process does nothing else, so that a signal may end it."""
    options, overrides = split_options(Options, values)
    with ending_at_once() if alone else nullcontext():
        config, makers, team, options = _build(options, overrides)
    out = make_out(options.out, team.folder / "eval")

    with ExitStack() as files:
        writer = None
        if options.trajectories:
            writer = files.enter_context(TrajectoryWriter(out, config, options.episodes, options.seed))
        episodes = _fly_all(config, makers, team, options, writer)
        report = make_report(config, options.seed, episodes.pop(team.name), episodes)
        print(f"\n{team.source}: {options.episodes} episodes, seed {options.seed}; mean (95 % interval)\n")
        print(format_table(report, team.name))
        if reasons := format_reasons(report, team.name):
            print(f"\n{reasons}")
        write_report(out / "metrics.json", report)
        print(f"\nwrote {out / 'metrics.json'}")
        if writer is not None:
            writer.finish()
            print("wrote " + " and ".join(str(path) for path in writer.files))
    with interrupted_by_signals():  # anew: Ray takes handlers away when it ends
        _draw(config, makers, team, options, out)
    return 0


def _build(options: Options, overrides: dict[str, Any]) -> tuple[Config, dict[str, Any], _Team, Options]:
    """Return environment, makers of all policies by name, the team, and the options with their baseline."""
    check_needs(options, _NEEDS)
    _check_source(options)
    chosen = options.baseline
    baseline = None if chosen in (None, "none") else find_policy(chosen, "baseline", ["none"])
    team = _find_team(options, overrides)
    limit_torch_threads()
    config = choose_config(None, team.config, {"env.num_threads": 0} | overrides)
    team.check(config)
    if baseline is not None:
        baseline.check(config, "baseline")
    _ = config.system
    probe = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}))
    makers, fitting = {team.name: team.make}, fitting_scripts(probe)
    if chosen is None:
        chosen = next((name for name in ("formation_integral", *fitting) if name in fitting), "none")
        options = options.model_copy(update={"baseline": chosen})
    if chosen != "none":
        makers |= {name: find_policy(name).bind for name in fitting if name != team.name}
    if baseline is not None:
        makers.setdefault(chosen, baseline.bind)
    for make in makers.values():  # refuses what does not fit, before there is a folder
        make(probe)
    if options.bag is not None:
        from multilift_marl.deploy.ros.bag import check_free

        check_free(Path(options.bag))
    return config, makers, team, options


class _Team(NamedTuple):
    """What is evaluated."""

    name: str
    """Of its column: "policy" for a learned one, else its name."""
    source: str
    config: Config
    make: Callable[[MultiliftVec], Any]
    folder: Path
    """That its evaluations belong to."""
    check: Callable[[Config], None]
    """Refuses environments that it cannot fly, before they are made."""


def _check_source(options: Options) -> None:
    """Refuse keys of a run beside another policy, and a configuration alone."""
    wrong = [key for key in ("run", "checkpoint") if key in options.model_fields_set]
    if options.policy is not None and wrong:
        raise ConfigError(f"policy={options.policy} takes the place of a run and has no {wrong[0]}; leave out one")
    if options.config is not None and options.policy is None and "run" not in options.model_fields_set:
        raise ConfigError(
            f"config={options.config} says where to fly, but not who does: add run=<run or shipped policy>, run=latest "
            "say, or policy=formation"
        )


def _find_named(options: Options, policy: NamedPolicy, name: str, overrides: dict[str, Any]) -> _Team:
    """Return a policy by name in the environment of `config`, in its own one where that is not given."""
    if policy.config is None or options.config is not None:
        config = load_config(options.config or "hover", overrides)
        where = title(overrides | {"config": options.config})
    else:
        config, where = policy.config, policy.config.task
    module, _, kind = name.rpartition(":")
    label = f"{Path(module).name.removesuffix('.py')}.{kind}" if module else Path(name).stem
    return _Team(
        name,
        f"{name} on {where}",
        config,
        policy.bind,
        Path("runs") / f"{label}-{where}",
        partial(policy.check, role="policy"),
    )


def _find_team(options: Options, overrides: dict[str, Any]) -> _Team:
    if options.config is not None:
        load_config(options.config, overrides)  # whose name is checked before any policy is loaded
    if options.policy is not None:
        _refuse_recipe("policy", options.policy)
        return _find_named(options, find_policy(options.policy), options.policy, overrides)
    _refuse_recipe("run", options.run)
    policy = load_policy(options.run, options.checkpoint)
    untrained = getattr(policy, "frames", None) == 0 and not Path(options.run).is_file()
    if options.checkpoint == "best" and untrained:
        print(f"note: {UNTRAINED}")
    if options.config is not None:
        return _find_named(options, policy, options.run, overrides)
    return _Team("policy", policy.source, policy.config, policy.bind, policy.folder, policy.check)


def _refuse_recipe(key: str, name: str) -> None:
    """Refuse the name of a recipe that no policy has, and say what it is good for."""
    taken = name in (*SCRIPTED, *shipped_policies()) or any(Path(each).exists() for each in (name, f"runs/{name}"))
    if name in list_configs() and not taken:
        train = spell_command("train", f"config={name}")
        raise ConfigError(
            f"{key}={name} is a recipe that no shipped policy was trained by; train one by {train}, or fly a baseline "
            f"in it by policy=formation config={name}"
        )


def _fly_all(
    config: Config, makers: dict[str, Any], team: _Team, options: Options, writer: TrajectoryWriter | None
) -> dict[str, dict[str, np.ndarray]]:
    """Return the metrics of each policy's episodes by name; record those of the team."""
    evaluation = Evaluation(options.episodes, options.seed, options.workers)
    order = sorted(makers, key=lambda name: ":" not in name)  # one's own first: should they fail, nothing is lost
    with interrupted_by_signals(), ExitStack() as stack:
        if options.workers:
            stack.enter_context(cluster(options.ray, options.workers))
            stack.enter_context(interrupted_by_signals())  # in place of Ray's handler
        return {
            name: fly(config, makers[name], name, evaluation, writer if name == team.name else None) for name in order
        }


def fly(
    config: Config, maker: Any, name: str, evaluation: Evaluation, writer: TrajectoryWriter | None = None
) -> dict[str, np.ndarray]:
    """Do as `run_episodes`, or `evaluate_parallel` with workers, beside a bar with the name of what flies."""
    from tqdm import tqdm

    episodes, seed, workers, factors = evaluation
    with tqdm(total=episodes, desc=name, unit="episode", leave=False) as bar:

        def progress(done: int) -> None:
            bar.update(done - bar.n)

        if workers:
            return evaluate_parallel(config, maker, evaluation, progress, writer)
        record = None if writer is None else writer.record
        return run_episodes(config, maker, episodes, seed, progress=progress, factors=factors, record=record)


def _draw(config: Config, makers: dict[str, Any], team: _Team, options: Options, out: Path) -> None:
    """Plot the first episode of policy and baseline, and the training; film the policy if asked."""
    from multilift_marl.evaluation import plots

    beside = [] if options.baseline in (None, "none") else [str(options.baseline)]
    names = dict.fromkeys([team.name, *beside])
    traces = {name: trace_episode(config, makers[name], 0, options.seed) for name in names if name != team.name}
    traces = {team.name: _trace(config, team, options)} | traces
    above, pdf = f"{team.name}, episode 0", options.plots == "pdf"
    plots.plot_errors(out / "errors.png", traces, pdf)
    plots.plot_tensions(out / "tensions.png", traces[team.name], above, pdf)
    plots.plot_paths(out / "paths.png", traces[team.name], above, pdf)
    if options.policy is None:
        from multilift_marl.agents.logging import read_metrics
        from multilift_marl.tasks import find_task

        if rows := read_metrics(team.folder):
            plots.plot_training(out / "training.png", rows, pdf, find_task(config.task).ERROR)
    print(f"wrote plots in {out}")
    if options.video:
        try:
            _film(config, team.make, options, out / "episode_0.mp4")
        except RenderingError as error:
            print(f"no video: {error}", file=sys.stderr)


def _trace(config: Config, team: _Team, options: Options) -> Trace:
    """Return the trace of the first episode; record it in a bag if asked."""
    if options.bag is None:
        return trace_episode(config, team.make, 0, options.seed)
    from multilift_marl.deploy.ros.bag import BagWriter

    bags: list[BagWriter] = []
    with ExitStack() as stack:

        def record(vec: MultiliftVec) -> None:
            if not bags:
                folder = Path(str(options.bag))
                bags.append(stack.enter_context(BagWriter(folder, vec, options.ros, options.names)))
            else:
                bags[0].write(vec.steps[0] * vec.task.dt)

        trace = trace_episode(config, team.make, 0, options.seed, record)
    print(f"wrote {options.bag}")
    return trace


def _film(config: Config, maker: Any, options: Options, path: Path) -> None:
    """Film the first episode, every other policy step."""
    from tqdm import tqdm

    from multilift_marl import rendering

    tools: list[Any] = []  # made with the first frame, so that no empty file is left where there is no OpenGL
    with ExitStack() as stack:
        steps = round(config.env.episode_seconds * config.env.policy_hz)
        bar = stack.enter_context(tqdm(total=steps // 2 + 1, desc="filming", unit="frame", leave=False))

        def shoot(vec: Any) -> None:
            if not tools:
                tools.append(stack.enter_context(rendering.Renderer(vec, camera=options.camera, trail=options.trail)))
                tools.append(stack.enter_context(rendering.VideoWriter(path, config.env.policy_hz / 2)))
            renderer, video = tools
            if vec.steps[0] % 2 == 0:
                video.append(renderer.frame())
                bar.update()

        trace_episode(config, maker, 0, options.seed, shoot)
    print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
