"""A training run: collect, learn, evaluate, log, save; resumable at any iteration, bit for bit."""

from __future__ import annotations

import itertools
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from multilift_marl._platform import STOPPING, handles_signals
from multilift_marl.agents.checkpoint import (
    check_like,
    clear_leftovers,
    load_checkpoint,
    lock_run,
    save_checkpoint,
    unlock_run,
)
from multilift_marl.agents.episodes import EpisodeStatistics
from multilift_marl.agents.evaluator import Evaluator, Gain
from multilift_marl.agents.logging import RunLog, write_versions
from multilift_marl.agents.mappo import (
    StochasticPolicy,
    adapted_rate,
    check_batch,
    check_communication,
    make_learner,
    update,
)
from multilift_marl.agents.policy import check_policy
from multilift_marl.agents.rigs import check_rigs, divide_rigs
from multilift_marl.agents.rollouts import RigRollouts, Rollouts
from multilift_marl.agents.workers import Workers
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, dump_config
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import CheckpointError, ConfigError, reason
from multilift_marl.evaluation.rollout import trace_episode

_NEEDED = ("critic", "optimizer", "rng", "env", "returns", "iteration", "seconds", "best_policy")


class Trainer:
    """Trains one configuration in one run folder.

    Args:
        config: what to train.
        folder: the run's folder; nothing is written there before `run` or `save`.
        checkpoint: content of the checkpoint to go on from.

    Attributes:
        status: exit status of a process whose training was stopped.
        evaluator: knows the best policy so far.
        gain: what training gained over its script, once it has finished.
    """

    def __init__(self, config: Config, folder: Path, checkpoint: dict[str, Any] | None = None):
        torch.set_num_threads(1)
        torch.manual_seed(config.seed)
        self.config, self.folder = config, folder
        for key in config.train.overrides:
            if key.partition(".")[0] in ("task", "seed", "train", "eval"):
                raise ConfigError(f"train.overrides changes the environment and cannot hold '{key}'; set {key} itself")
        environment = build_config(config.model_dump(), config.train.overrides)
        for env in (config.env, environment.env):
            check_communication(config.train, env)
        train, num_envs = config.train, environment.env.num_envs
        rigs = divide_rigs(environment)
        envs = [MultiliftEnv(rig, first_env=k * rig.env.num_envs, memory=train.gru) for k, rig in enumerate(rigs)]
        check_rigs(train, [env.vec for env in envs])
        self.env = envs[0]
        self.frames_per_batch = num_envs * train.horizon
        check_batch(train, self.env.vec, num_envs, len(envs))
        self.learner = make_learner(train, self.env)
        self.rollouts: Rollouts | RigRollouts | Workers
        if train.workers == 0:
            policies = [self.learner.policy, *(StochasticPolicy(self.learner.actor) for _ in envs[1:])]
            parts = [Rollouts(env, own, train.horizon, num_envs) for env, own in zip(envs, policies, strict=True)]
            self.rollouts = RigRollouts(parts) if train.rigs else parts[0]
        else:
            self.rollouts = Workers(environment, self.learner.actor)
        self.iterations = -(-config.train.frames // self.frames_per_batch)
        self.iteration, self.seconds = 0, 0.0
        self.evaluator = Evaluator(config)
        self.gain: Gain | None = None
        self.episodes = EpisodeStatistics(self.env.vec, num_envs)
        self._stop, self._warned, self._best_saved, self.status = False, False, True, 128 + signal.SIGINT
        if checkpoint is not None:
            self._restore(checkpoint)
            torch.set_rng_state(checkpoint["rng"])

    def run(self) -> bool:
        """Train to the end; return False if the user stopped it.

        Ctrl-C, SIGTERM and SIGHUP save and stop, a second one stops at once; threads other than the main one leave
        signals alone. A disk that is full is no reason to stop: what could not be written is written again after the
        next iteration.

        Raises:
            CheckpointError: another process trains this run, or its end could not be saved.
        """
        lock_run(self.folder)
        with ExitStack() as stack:
            stack.callback(unlock_run, self.folder)
            stack.callback(self.rollouts.close)
            clear_leftovers(self.folder)
            for number in STOPPING if handles_signals() else ():
                if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN:  # nohup's stays
                    stack.callback(signal.signal, number, signal.signal(number, self._interrupt))
            log = RunLog(self.folder, self.iteration, self.frames)
            stack.callback(log.close)
            self._attempt(partial(log.write_text, "configuration", dump_config(self.config), self.frames))
            name = f"{self.config.task} {self.config.train.algorithm}"
            bar = tqdm(total=self.iterations, initial=self.iteration, desc=name, unit="it", dynamic_ncols=True)
            stack.callback(_quietly, bar.close)
            self._train(log, bar, name)
        return not self._stop

    def _train(self, log: RunLog, bar: tqdm, name: str) -> None:
        shown: dict[str, str] = {}
        unsaved = False
        self._best_saved = self._attempt(self._restore_best)
        while not (self.finished or self._stop):
            start = time.perf_counter()
            first = self.evaluator.best is None  # the untrained policy, which acts as the script
            values = {} if first else self.step()
            if "return" in values:
                shown["return"] = f"{values['return']:.0f}"
            last = self.iteration >= self.iterations
            if first or self.iteration % self.config.eval.every == 0 or last:
                _quietly(bar.set_description, f"{name}, evaluating")
                values |= self.evaluate()
                _quietly(bar.set_description, name)
                shown["success"] = f"{values['eval/success_rate']:.0%}"
                shown["error"] = f"{100 * values['eval/payload_position_error_m']:.2f} cm"
                shown["best"] = f"{values['eval/best_iteration']:.0f}"
            if last:
                self.gain = self.evaluator.measure_gain(self.iteration)
                values |= self.gain.values()
            self._attempt(partial(log.write, {"iteration": self.iteration, "frames": self.frames}, values))
            self.seconds += time.perf_counter() - start
            if not self._best_saved:
                self._best_saved = self._attempt(self._restore_best)
            if unsaved or first or self.iteration % self.config.train.checkpoint_every == 0 or last or self._stop:
                unsaved = not self._attempt(partial(self.save, "last"))
            if values.get("eval/best_iteration") == self.iteration:
                self._attempt(lambda: log.write_picture("flight", self._draw_best(), self.frames))
            _quietly(bar.set_postfix, shown)
            _quietly(bar.update, not first)
        if unsaved:
            spare = Path(tempfile.gettempdir()) / f"{self.folder.name}-last.pt"
            self.save("last", spare)
            raise CheckpointError(
                f"cannot write into {self.folder}: the run is saved as {spare}; make room, move it to "
                f"{self.folder / 'checkpoints' / 'last.pt'}, and resume"
            )

    def _attempt(self, write: Callable[[], None]) -> bool:
        """Return whether `write` could write; say so if not, once."""
        try:
            write()
        except (OSError, CheckpointError) as error:
            if not self._warned:
                _quietly(tqdm.write, f"warning: {error}; training goes on and tries again after each iteration")
            self._warned = True
            return False
        return True

    @property
    def finished(self) -> bool:
        """Whether all of its iterations are done."""
        return self.iteration >= self.iterations

    def step(self) -> dict[str, float]:
        """Collect one batch, learn from it, and return the iteration's numbers."""
        start, train, optimizer = time.perf_counter(), self.config.train, self.learner.optimizer
        left = 1 - (1 - train.final_learning_rate) * self.iteration / self.iterations
        actor, critic = optimizer.param_groups
        if not train.desired_kl:
            actor["lr"] = train.learning_rate * left
        critic["lr"] = train.critic_learning_rate * left if train.critic_learning_rate else actor["lr"]
        rate = actor["lr"]
        if self.iteration < train.warmup:
            actor["lr"] = 0.0
        batches = self.rollouts.collect(self.iteration)
        sampling = time.perf_counter() - start
        torch.set_num_threads(train.threads)
        values = update(self.learner, batches)
        torch.set_num_threads(1)
        actor["lr"] = rate
        if train.desired_kl and self.iteration >= train.warmup:
            actor["lr"] = adapted_rate(rate, values["approx_kl"], train.desired_kl)
        learning = values.pop("learning_seconds")
        values |= self.episodes.read(batches, self.iteration)
        self.iteration += 1
        return values | {
            "learning_rate": rate,
            "fps": self.frames_per_batch / (sampling + learning),
            "share_sampling": sampling / (sampling + learning),
            "share_learning": learning / (sampling + learning),
        }

    @property
    def frames(self) -> int:
        """Environment steps so far."""
        return self.iteration * self.frames_per_batch

    def evaluate(self) -> dict[str, float]:
        """Fly the policy without exploration on seeds of evaluation during training; keep it if it is the best."""
        values = self.evaluator.evaluate(self._content())
        if values["eval/best_iteration"] == self.iteration:
            self._best_saved = self._attempt(partial(self.save, "best"))
        return values

    def save(self, name: str, path: Path | None = None) -> None:
        """Write checkpoints/<name>.pt, or `path`; a CheckpointError if that cannot be."""
        path = path or self.folder / "checkpoints" / f"{name}.pt"
        save_checkpoint(path, self._content() | self._training_state())

    def _content(self) -> dict[str, Any]:
        """Return what a policy needs."""
        vec = self.env.vec
        return {
            "config": self.config.model_dump(mode="json"),
            "actor": self.learner.actor.state_dict(),
            "observation_names": list(vec.observation_names),
            "action_names": list(vec.action_names),
            "frames": self.frames,
            "iteration": self.iteration,
        }

    def _training_state(self) -> dict[str, Any]:
        """Return what else training depends on."""
        return self._learning_state() | {"env": self.rollouts.get_state()}

    def _learning_state(self) -> dict[str, Any]:
        """Return what learning depends on."""
        return {
            "critic": self.learner.critic.state_dict(),  # with its normaliser and that of the values
            "optimizer": self.learner.optimizer.state_dict(),
            "rng": torch.get_rng_state(),
            "returns": torch.from_numpy(self.episodes.returns.copy()),
            "seconds": self.seconds,
            "best_policy": self.evaluator.best,
        }

    def _restore(self, content: dict[str, Any]) -> None:
        if missing := [key for key in _NEEDED if key not in content]:
            raise CheckpointError(
                f"the checkpoint cannot be resumed, '{missing[0]}' is missing; give a training run's, of this version"
            )
        try:
            self._load(content)
        except Exception as error:  # torch's optimizers raise many kinds
            raise CheckpointError(
                f"the checkpoint does not fit this version or system ({reason(error)}); train anew"
            ) from error

    def _load(self, content: dict[str, Any]) -> None:
        optimizer = self.learner.optimizer
        own = self._content() | self._learning_state()
        for key in ("critic", "rng", "returns", "iteration", "seconds"):
            check_like(content[key], own[key], key)
        if content["best_policy"] is not None:
            check_policy(content["best_policy"], "'best_policy'")
            check_like(content["best_policy"]["actor"], self.learner.actor.state_dict(), "best_policy.actor")
        check_like(content["actor"], self.learner.actor.state_dict(), "actor")
        torch.Generator().set_state(content["rng"])  # refuses what is no state
        if content["iteration"] < 0:
            raise ValueError("'iteration' is negative")
        self.rollouts.set_state(content["env"])
        self.learner.actor.load_state_dict(content["actor"])
        self.learner.critic.load_state_dict(content["critic"])
        optimizer.load_state_dict(content["optimizer"])
        for group, expected in zip(optimizer.param_groups, own["optimizer"]["param_groups"], strict=True):
            for key in expected.keys() - {"params"}:
                check_like(group[key], expected[key], f"optimizer.{key}")
        for parameter, moments in optimizer.state.items():
            like = {"step": torch.zeros(()), "exp_avg": parameter.data, "exp_avg_sq": parameter.data}
            check_like(moments, like, "optimizer.state")
        self.episodes.returns[:] = content["returns"].numpy()
        self.iteration, self.seconds = content["iteration"], content["seconds"]
        self.evaluator.best = content["best_policy"]

    def _restore_best(self) -> None:
        """Write the best policy of a resumed run, which may have found another one after its last checkpoint."""
        best, path = self.evaluator.best, self.folder / "checkpoints" / "best.pt"
        if best is not None and not (path.is_file() and load_checkpoint(path).get("iteration") == best["iteration"]):
            save_checkpoint(path, best)

    def _draw_best(self) -> Path:
        """Return the path of a picture of the first episode of the best policy."""
        from multilift_marl.evaluation.plots import plot_paths  # matplotlib takes a while

        policy, path = self.evaluator.best_policy(), self.folder / "flight.png"
        trace = trace_episode(self.config, policy.bind, 0, self.config.seed)
        plot_paths(path, trace, f"best policy so far, iteration {self.iteration}")
        return path

    def _interrupt(self, signum: int, frame: Any) -> None:
        if self._stop:
            raise KeyboardInterrupt
        self._stop, self.status = True, 128 + signum
        _quietly(tqdm.write, "stopping after this iteration; press Ctrl-C again to stop at once")


def _quietly(show: Callable[..., object], *arguments: Any) -> None:
    """Show something on a terminal that may be gone."""
    with suppress(OSError):
        show(*arguments)


def new_run(config: Config, name: str, runs: Path = Path("runs")) -> Trainer:
    """Return the trainer of a new run in runs/<name>-<time>-s<seed>/, with configuration and versions in it.

    Raises:
        ConfigError: what cannot be trained; no folder is made then.
    """
    trainer = Trainer(config, runs)
    try:
        runs.mkdir(parents=True, exist_ok=True)
        trainer.folder = _make_folder(runs, f"{name}-{time.strftime('%Y%m%d-%H%M%S')}-s{config.seed}")
        (trainer.folder / "checkpoints").mkdir()
    except OSError as error:
        raise ConfigError(f"cannot make a run in {runs}/ ({reason(error)}); train in another folder") from error
    (trainer.folder / "config.yaml").write_text(dump_config(config), encoding="utf-8")
    write_versions(trainer.folder)
    return trainer


def _make_folder(runs: Path, stem: str) -> Path:
    """Return a new folder of this name, or of the next one that is free."""
    for again in itertools.count(1):
        folder = runs / (stem if again == 1 else f"{stem}-{again}")
        with suppress(FileExistsError):
            folder.mkdir()
            break
    return folder


def resume_run(folder: Path, overrides: dict[str, Any]) -> Trainer:
    """Return a trainer that goes on from the last checkpoint of `folder`.

    Raises:
        CheckpointError: there is none that can be read, or another process trains this run.
        ConfigError: an override that a run in progress cannot take.
    """
    lock_run(folder)
    path = folder / "checkpoints" / "last.pt"
    content = load_checkpoint(path)
    check_policy(content, str(path))
    config = build_config(content["config"], overrides)
    trainer = Trainer(config, folder, content)
    (folder / "config.yaml").write_text(dump_config(config), encoding="utf-8")
    return trainer
