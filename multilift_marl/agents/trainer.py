"""A training run: collect, learn, evaluate, log, save; resumable at any iteration, bit for bit."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import torch
from tqdm import tqdm

from multilift_marl._files import check_writable, make_run_folder, write_whole
from multilift_marl.agents.checkpoint import (
    clear_leftovers,
    copy_content,
    load_checkpoint,
    lock_run,
    making_run,
    save_checkpoint,
    saved_iteration,
    unlock_run,
)
from multilift_marl.agents.curriculum import Curriculum
from multilift_marl.agents.environments import make_envs, make_rollouts
from multilift_marl.agents.episodes import EpisodeStatistics
from multilift_marl.agents.evaluator import Evaluator, Gain
from multilift_marl.agents.initial import find_initial
from multilift_marl.agents.learning_rollouts import LearningRollouts
from multilift_marl.agents.loggers import check_logger, hyperparameters
from multilift_marl.agents.logging import RunLog, describe_evaluation, quietly, say, write_versions
from multilift_marl.agents.mappo import adapted_rate, check_batch, check_finite, in_warmup, make_learner, update
from multilift_marl.agents.policy import check_policy
from multilift_marl.agents.resuming import check_content, check_needed, load_networks
from multilift_marl.agents.rigs import divide_rigs
from multilift_marl.agents.stopping import Abandoned, Stopper
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, dump_config
from multilift_marl.config.precedence import give_way
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import CheckpointError, ConfigError, reason
from multilift_marl.plugins import import_modules
from multilift_marl.trust import check_cluster, review


class Trainer:
    """Trains one configuration in one run folder.

    Args:
        config: what to train.
        folder: the run's folder; nothing is written there before `run` or `save`.
        checkpoint: content of the checkpoint to go on from.

    Attributes:
        evaluator: knows the best policy so far.
        gain: what training gained over the policy that it began with, once it has finished.
        curriculum: the stage that training is in.
        taken_over: of `train.init`, what a new run starts with: actor, and critic where that fits.
    """

    def __init__(self, config: Config, folder: Path, checkpoint: dict[str, Any] | None = None):
        # One thread in rollouts, where those of the environments have the cores; `step` gives learning its own number.
        torch.set_num_threads(1)
        # Before networks are made: their first weights are drawn from it.
        torch.manual_seed(config.seed)
        config, initial = find_initial(config) if checkpoint is None else (config, None)
        self.config, self.folder = config, folder
        check_logger(config.train.logger)
        if config.train.workers:
            check_cluster(config.train.ray)
        self.curriculum = Curriculum(config, checkpoint)
        environment = self.curriculum.environment
        if initial is not None:
            initial.check(divide_rigs(environment))
        envs = make_envs(environment, self.curriculum.purpose)
        self.frames_per_batch = environment.env.num_envs * config.train.horizon
        check_batch(config.train, envs[0].vec, environment.env.num_envs, len(envs))
        self.learner = make_learner(config.train, envs[0])
        self.taken_over = "" if initial is None else initial.take_over(self.learner, config)
        self._simulate(envs)
        # Rounded up: the last batch is a whole one, too.
        self.iterations = -(-config.train.frames // self.frames_per_batch)
        self.iteration, self.seconds = 0, 0.0
        self.evaluator = Evaluator(config)
        self.gain: Gain | None = None
        self._warned, self._best_saved = False, True
        self._stopper = Stopper(self._rescue, say)
        self._begun: dict[str, Any] | None = None  # what a checkpoint holds at the beginning of the iteration
        self._saved_iteration = -1
        # Last, since all that is made above has drawn random numbers: the run goes on as if it had never stopped.
        if checkpoint is not None:
            self._restore(checkpoint)
            torch.set_rng_state(checkpoint["rng"])
            self._saved_iteration, self._stopper.worth = self.iteration, True
        elif initial is not None:
            self.evaluator.initial = copy_content(self._content())

    def run(self, ends: bool = False) -> bool:
        """Train to the end; return False if the user stopped it.

        Ctrl-C, SIGTERM and SIGHUP save and stop, see `Stopper`. What is saved when an iteration takes too long is its
        beginning: resumed, it is done again, bit for bit. A disk that is full is no reason to stop: what could not be
        written is written again after the next iteration.

        Args:
            ends: whether a signal may end the process, which does nothing else; otherwise it may raise.

        Raises:
            CheckpointError: another process trains this run, or its end could not be saved.
            KeyboardInterrupt: a second signal, or one before there is anything to save.
        """
        self._stopper.ends = ends
        lock_run(self.folder)
        with ExitStack() as stack:
            stack.callback(unlock_run, self.folder)
            stack.enter_context(self._stopper)
            stack.callback(self._close)
            clear_leftovers(self.folder)
            log = RunLog(self.folder, self.iteration, self.frames, self.config.train.logger)
            stack.callback(log.close)
            self._attempt(partial(log.write_hyperparameters, hyperparameters(self.config)))
            self._attempt(partial(log.write_text, "configuration", dump_config(self.config), self.frames))
            name = f"{self.config.task} {self.config.train.algorithm}"
            bar = tqdm(total=self.iterations, initial=self.iteration, desc=name, unit="it", dynamic_ncols=True)
            stack.callback(quietly, bar.close)
            try:
                self._train(log, bar, name)
            except Abandoned:
                self._rescue()
            except ConfigError:  # of workers that are lost, say, or of networks that are
                self._rescue()
                raise
            finally:
                self._stopper.end()
        return not self._stopper.asked

    def _close(self) -> None:
        """End the rollouts, those of the last stage."""
        self.rollouts.close(at_once=self._stopper.ends and self._stopper.asked)

    @property
    def status(self) -> int:
        """Exit status of a process whose training was stopped."""
        return self._stopper.status

    def _train(self, log: RunLog, bar: tqdm, name: str) -> None:
        shown: dict[str, str] = {}
        unsaved = tabled = False
        self._best_saved = self._attempt(self._restore_best)
        if in_warmup(self.config.train, self.iterations - 1):
            say(
                f"warning: the policy of this training learns nothing: its {self.iterations} iterations are within "
                f"train.warmup={self.config.train.warmup}, where the critic learns alone; lower train.warmup or raise "
                "train.frames"
            )
        while not (self.finished or self._stopper.asked):
            start = time.perf_counter()
            first = self.evaluator.best is None  # the policy that it begins with; untrained, it acts as its base policy
            if not first:
                # An iteration that is given up leaves networks and environments half-way: this is what is saved then.
                self._begun = copy_content(self._content() | self._training_state())
            values = {} if first else self.step()
            if "return" in values:
                shown["return"] = f"{values['return']:.0f}"
            last = self.iteration >= self.iterations
            if first or self.iteration % self.config.eval.every == 0 or last:
                quietly(bar.set_description, f"{name}, evaluating")
                values |= self.evaluate()
                quietly(bar.set_description, name)
                say(describe_evaluation(self.frames, values, self.evaluator.error, header=not tabled))
                tabled = True
                shown["best"] = f"{values['eval/best_iteration']:.0f}"
            if last:
                self.gain = self.evaluator.measure_gain(self.iteration)
                values |= self.gain.values()
            values |= self.curriculum.values()
            self._attempt(partial(log.write, {"iteration": self.iteration, "frames": self.frames}, values))
            # After the log, whose numbers are of the stage that is over, and before saving: a run resumes in the new
            # stage.
            self._advance(values.get("eval/stage_success_rate"))
            self.seconds += time.perf_counter() - start
            if not self._best_saved:
                self._best_saved = self._attempt(self._restore_best)
            due = self.iteration % self.config.train.checkpoint_every == 0
            if unsaved or first or due or last or self._stopper.asked:
                unsaved = not self._attempt(partial(self.save, "last"))
            if values.get("eval/best_iteration") == self.iteration:
                self._attempt(lambda: log.write_picture("flight", self.evaluator.draw_best(self.folder), self.frames))
            quietly(bar.set_postfix, shown)
            quietly(bar.update, not first)
        if unsaved:
            with self._stopper.writing():
                self._save_elsewhere(self._content() | self._training_state())

    def _attempt(self, write: Callable[[], None]) -> bool:
        """Return whether `write` could write; say so if not, once."""
        try:
            write()
        except (OSError, CheckpointError) as error:
            if not self._warned:
                say(f"warning: {error}; training goes on and tries again after each iteration")
            self._warned = True
            return False
        return True

    def _simulate(self, envs: list[MultiliftEnv]) -> None:
        """Have the policy act in the environments of the present stage."""
        self.env, environment = envs[0], self.curriculum.environment
        self.rollouts = make_rollouts(environment, envs, self.learner)
        vecs, began = [env.vec for env in envs], self.curriculum.began
        self.episodes = EpisodeStatistics(vecs, environment.env.num_envs, began)

    def _advance(self, success: float | None) -> None:
        """Go on to the next stage where the present one is over."""
        if not self.finished and self.curriculum.is_over(self.frames, success):
            self.rollouts.close()
            say(self.curriculum.advance(self.iteration))
            self._simulate(make_envs(self.curriculum.environment, self.curriculum.purpose))

    @property
    def finished(self) -> bool:
        """Whether all of its iterations are done."""
        return self.iteration >= self.iterations

    def step(self) -> dict[str, float]:
        """Collect one batch, learn from it, and return the iteration's numbers."""
        start, train, optimizer = time.perf_counter(), self.config.train, self.learner.optimizer
        # Linear, from 1 at first to the final share after all iterations.
        left = 1 - (1 - train.final_learning_rate) * self.iteration / self.iterations
        actor, critic = optimizer.param_groups
        if not train.desired_kl:
            actor["lr"] = train.learning_rate * left
        # Before the warm-up takes the actor's rate, which the critic may share.
        critic["lr"] = train.critic_learning_rate * left if train.critic_learning_rate else actor["lr"]
        rate = actor["lr"]
        if in_warmup(train, self.iteration):
            actor["lr"] = 0.0
        batches = self.rollouts.collect(self.iteration)
        sampling = time.perf_counter() - start
        if isinstance(self.rollouts, LearningRollouts):  # it has learned on the way
            values = dict(self.rollouts.values)
            sampling -= values["learning_seconds"]
        else:
            torch.set_num_threads(train.threads)
            values = update(self.learner, batches)
            torch.set_num_threads(1)
        check_finite(self.learner, self.iteration)
        actor["lr"] = rate
        # In the warm-up the policy does not move: a KL of 0 would only raise the rate.
        if train.desired_kl and self.iteration >= train.warmup and "approx_kl" in values:
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
        if self.curriculum.needs_success:
            success = self.evaluator.measure_success(self._content(), self.curriculum.environment)
            values["eval/stage_success_rate"] = success
        return values

    def save(self, name: str, path: Path | None = None) -> None:
        """Write checkpoints/<name>.pt, or `path`; a CheckpointError if that cannot be."""
        path = path or self.folder / "checkpoints" / f"{name}.pt"
        with self._stopper.writing():
            save_checkpoint(path, self._content() | self._training_state())
            if name == "last":
                self._saved_iteration = self.iteration

    def _rescue(self) -> None:
        """Save the beginning of the iteration that is given up, unless that, or its end, is on the disk."""
        if self._begun is not None and self._begun["iteration"] > self._saved_iteration:
            try:
                save_checkpoint(self.folder / "checkpoints" / "last.pt", self._begun)
            except CheckpointError:
                self._save_elsewhere(self._begun)

    def _save_elsewhere(self, content: dict[str, Any]) -> NoReturn:
        """Write what the run's folder does not take; a CheckpointError says where."""
        spare = Path(tempfile.gettempdir()) / f"{self.folder.name}-last.pt"
        save_checkpoint(spare, content)
        raise CheckpointError(
            f"cannot write into {self.folder}: the run is saved as {spare}; make room, move it to "
            f"{self.folder / 'checkpoints' / 'last.pt'}, and resume"
        )

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
            **({} if self.evaluator.initial is None else {"initial_policy": self.evaluator.initial}),
            **self.curriculum.state(),
        }

    def _restore(self, content: dict[str, Any]) -> None:
        """Go on from the content of a checkpoint, a CheckpointError if it does not fit."""
        check_needed(content, self.config.train)
        try:
            check_content(content, self._content() | self._learning_state(), self.learner)
            self.rollouts.set_state(content["env"])
            load_networks(content, self.learner)
        except Exception as error:  # torch's optimizers raise many kinds
            raise CheckpointError(
                f"the checkpoint does not fit this version or system ({reason(error)}); train anew"
            ) from error
        if isinstance(self.rollouts, LearningRollouts) and self.rollouts.begins_anew:
            self.episodes.began = content["iteration"]
        else:
            self.episodes.returns[:] = content["returns"].numpy()
        self.iteration, self.seconds = content["iteration"], content["seconds"]
        self.evaluator.best, self.evaluator.initial = content["best_policy"], content.get("initial_policy")

    def _restore_best(self) -> None:
        """Write the best policy of a resumed run, which may have found another one after its last checkpoint."""
        best, path = self.evaluator.best, self.folder / "checkpoints" / "best.pt"
        if best is not None and saved_iteration(path) != best["iteration"]:
            save_checkpoint(path, best)


def new_run(config: Config, name: str, runs: Path = Path("runs")) -> Trainer:
    """Return the trainer of a new run in runs/<name>-<time>-s<seed>/, with configuration and versions in it.

    Raises:
        ConfigError: what cannot be trained, or written there; no folder is made then.
    """
    with making_run(runs):
        check_writable(runs)
    trainer = Trainer(config, runs)
    with making_run(runs):
        runs.mkdir(parents=True, exist_ok=True)
        trainer.folder = make_run_folder(runs, f"{name}-{time.strftime('%Y%m%d-%H%M%S')}-s{config.seed}")
        (trainer.folder / "checkpoints").mkdir()
        (trainer.folder / "config.yaml").write_text(dump_config(trainer.config), encoding="utf-8")
        write_versions(trainer.folder)
    return trainer


def resume_run(folder: Path, overrides: dict[str, Any]) -> Trainer:
    """Return a trainer that goes on from the last checkpoint of `folder`.

    Raises:
        CheckpointError: there is none that can be read, or another process trains this run.
        ConfigError: an override that a run in progress cannot take; a module or a cluster that only the run names, see
            `trust.review`.
    """
    import_modules(overrides.get("import"))
    # Before anything is read, for whoever trains this run may be about to write it.
    lock_run(folder)
    path = folder / "checkpoints" / "last.pt"
    content = load_checkpoint(path)
    check_policy(content, str(path))
    review(content["config"], path)
    config = build_config(give_way(content["config"], overrides), overrides)
    trainer = Trainer(config, folder, content)
    write_whole(folder / "config.yaml", dump_config(config).encode())
    return trainer
