"""A training run: collect, learn, evaluate, log, save; resumable at any iteration, bit for bit."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.collectors import Collector
from tqdm import tqdm

from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
from multilift_marl.agents.evaluator import Evaluator, Gain
from multilift_marl.agents.logging import RunLog, write_versions
from multilift_marl.agents.mappo import make_learner, update
from multilift_marl.config.load import build_config, dump_config
from multilift_marl.config.schema import Config
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import CheckpointError, ConfigError
from multilift_marl.evaluation.rollout import trace_episode

_NEEDED = ("loss", "optimizer", "rng", "env", "returns", "iteration", "seconds", "best_policy")


class Trainer:
    """Trains one configuration in one run folder.

    Args:
        config: what to train.
        folder: the run's folder; nothing is written there before `run` or `save`.
        checkpoint: content of the checkpoint to go on from.

    Attributes:
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
        self.env = MultiliftEnv(build_config(config.model_dump(), config.train.overrides))
        self.learner = make_learner(config.train, self.env)
        self.frames_per_batch = self.env.vec.num_envs * config.train.horizon
        if config.train.minibatches > self.frames_per_batch:
            raise ConfigError(
                f"train.minibatches={config.train.minibatches} exceeds the {self.frames_per_batch} steps of a batch; "
                "lower it or raise train.horizon or env.num_envs"
            )
        self.iterations = -(-config.train.frames // self.frames_per_batch)
        self.iteration, self.seconds = 0, 0.0
        self.evaluator = Evaluator(config)
        self.gain: Gain | None = None
        self._returns = np.zeros(self.env.vec.num_envs)  # of the episodes in flight
        self._stop = False
        if checkpoint is not None:
            self._restore(checkpoint)
        self.collector = Collector(
            self.env,
            self.learner.policy,
            frames_per_batch=self.frames_per_batch,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            return_same_td=True,  # a batch is used up before the next one
            device="cpu",
        )
        self._batches = iter(self.collector)
        if checkpoint is None:
            self.env.vec.stagger()
        else:
            torch.set_rng_state(checkpoint["rng"])

    def run(self) -> bool:
        """Train to the end; return False if the user stopped it. Ctrl-C saves and stops, a second one stops at once."""
        previous = signal.signal(signal.SIGINT, self._interrupt)
        log = RunLog(self.folder, self.iteration, self.frames)
        log.write_text("configuration", dump_config(self.config), self.frames)
        name = f"{self.config.task} {self.config.train.algorithm}"
        bar = tqdm(total=self.iterations, initial=self.iteration, desc=name, unit="it", dynamic_ncols=True)
        shown: dict[str, str] = {}
        try:
            self._restore_best()
            while not (self.finished or self._stop):
                start = time.perf_counter()
                first = self.evaluator.best is None  # the untrained policy, which flies the script
                values = {} if first else self.step()
                if "return" in values:
                    shown["return"] = f"{values['return']:.0f}"
                last = self.iteration >= self.iterations
                if first or self.iteration % self.config.eval.every == 0 or last:
                    bar.set_description(f"{name}, evaluating")
                    values |= self.evaluate()
                    bar.set_description(name)
                    shown["success"] = f"{values['eval/success_rate']:.0%}"
                    shown["error"] = f"{100 * values['eval/payload_position_error_m']:.2f} cm"
                    shown["best"] = f"{values['eval/best_iteration']:.0f}"
                if last:
                    self.gain = self.evaluator.measure_gain(self.iteration)
                    values |= self.gain.values()
                log.write({"iteration": self.iteration, "frames": self.frames}, values)
                self.seconds += time.perf_counter() - start
                if first or self.iteration % self.config.train.checkpoint_every == 0 or last or self._stop:
                    self.save("last")
                if values.get("eval/best_iteration") == self.iteration:
                    log.write_picture("flight", self._draw_best(), self.frames)
                bar.set_postfix(shown)
                bar.update(not first)
        finally:
            bar.close()
            log.close()
            signal.signal(signal.SIGINT, previous)
        return not self._stop

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
        batch = next(self._batches)
        sampling = time.perf_counter() - start
        torch.set_num_threads(train.threads)
        values = update(self.learner, batch)
        torch.set_num_threads(1)
        actor["lr"] = rate
        if train.desired_kl and self.iteration >= train.warmup:
            actor["lr"] = adapted_rate(rate, values["approx_kl"], train.desired_kl)
        learning = values.pop("learning_seconds")
        values |= self._episodes(batch)
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
            self.save("best")
        return values

    def save(self, name: str) -> None:
        """Write checkpoints/<name>.pt."""
        save_checkpoint(self.folder / "checkpoints" / f"{name}.pt", self._content() | self._training_state())

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
        return {
            "loss": self.learner.loss.state_dict(),  # actor and critic with normalisers, value normaliser
            "optimizer": self.learner.optimizer.state_dict(),
            "rng": torch.get_rng_state(),
            "env": self.env.get_state(),
            "returns": torch.from_numpy(self._returns.copy()),
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
        except (RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise CheckpointError(
                f"the checkpoint does not fit this version or system ({reason}); train anew"
            ) from error

    def _load(self, content: dict[str, Any]) -> None:
        self.learner.loss.load_state_dict(content["loss"])
        self.learner.optimizer.load_state_dict(content["optimizer"])
        self.env.set_state(content["env"])
        self._returns[:] = content["returns"].numpy()
        self.iteration, self.seconds = content["iteration"], content["seconds"]
        self.evaluator.best = content["best_policy"]

    def _restore_best(self) -> None:
        """Write the best policy of a resumed run, which may have found another one after its last checkpoint."""
        best, path = self.evaluator.best, self.folder / "checkpoints" / "best.pt"
        if best is not None and not (path.is_file() and load_checkpoint(path).get("iteration") == best["iteration"]):
            save_checkpoint(path, best)

    def _draw_best(self) -> Path:
        """Return the path of a picture of the first episode, flown by the best policy."""
        from multilift_marl.evaluation.plots import plot_paths  # matplotlib takes a while

        policy, path = self.evaluator.best_policy(), self.folder / "flight.png"
        trace = trace_episode(self.config, policy.bind, 0, self.config.seed)
        plot_paths(path, trace, f"best policy so far, iteration {self.iteration}")
        return path

    def _episodes(self, batch: Any) -> dict[str, float]:
        """Return statistics of the rollouts: reward terms, and of whole episodes that ended: return, success, failure.

        Nothing counts before an episode's length has passed: until then those end that the staggered start cut short,
        and of the whole ones that follow only the failures.
        """
        vec = self.env.vec
        rewards = batch["next", "agents", "reward"].mean(dim=(-2, -1)).double().numpy()
        done = batch["next", "done"].squeeze(-1).numpy()
        elapsed = self.iteration * done.shape[1] + np.arange(done.shape[1])
        counted = done & (elapsed >= vec.max_steps)
        finished = []
        for t in range(rewards.shape[1]):
            self._returns += rewards[:, t]
            finished += self._returns[counted[:, t]].tolist()
            self._returns[done[:, t]] = 0.0
        info = batch["next", "info"]
        terms = info["reward_terms"].mean(dim=(0, 1)).tolist()
        values = {f"reward/{name}": term for name, term in zip(vec.reward_terms, terms, strict=True)}
        values["reward/total"] = float(rewards.mean())
        if finished:
            values["return"] = float(np.mean(finished))
            for name in ("success", "failure"):
                values[name] = float(info[name].squeeze(-1).numpy()[counted].mean())
        values["diverged"] = info["diverged"].sum().item()
        return values

    def _interrupt(self, signum: int, frame: Any) -> None:
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True
        tqdm.write("stopping after this iteration; press Ctrl-C again to stop at once")


def adapted_rate(rate: float, kl: float, desired: float) -> float:
    """Return a learning rate that brings the KL of the next update closer to what is desired (Rudin et al. 2022)."""
    if kl > 2 * desired:
        return max(rate / 1.5, 1e-5)
    return min(rate * 1.5, 1e-2) if kl < desired / 2 else rate


def new_run(config: Config, name: str, runs: Path = Path("runs")) -> Trainer:
    """Return the trainer of a new run in runs/<name>-<time>-s<seed>/, with configuration and versions in it.

    Raises:
        ConfigError: what cannot be trained; no folder is made then.
    """
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}-s{config.seed}"
    trainer, again = Trainer(config, runs / stem), 1
    while trainer.folder.exists():
        again += 1
        trainer.folder = runs / f"{stem}-{again}"
    (trainer.folder / "checkpoints").mkdir(parents=True)
    (trainer.folder / "config.yaml").write_text(dump_config(config), encoding="utf-8")
    write_versions(trainer.folder)
    return trainer


def resume_run(folder: Path, overrides: dict[str, Any]) -> Trainer:
    """Return a trainer that goes on from the last checkpoint of `folder`.

    Raises:
        CheckpointError: there is none that can be read.
        ConfigError: an override that a run in progress cannot take.
    """
    content = load_checkpoint(folder / "checkpoints" / "last.pt")
    config = build_config(content["config"], overrides)
    trainer = Trainer(config, folder, content)
    (folder / "config.yaml").write_text(dump_config(config), encoding="utf-8")
    return trainer
