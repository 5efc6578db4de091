"""Search over any configuration keys with Ray Tune; trials that lag behind end early (ASHA, arXiv 1810.05934).

Install: pip install -e . -r examples/requirements/ray_tune.txt
Run: python examples/ray_tune.py [trials] [key=value ...] [key=loguniform(1e-4,1e-2) key=choice(64,128) ...]
Values like `uniform(a,b)`, `loguniform(a,b)`, `randint(a,b)` and `choice(a,b,...)` are searched, all else is fixed;
`config=gate` names another recipe. Each trial is a run in runs/, which evaluate.py can judge.
"""

import re
import sys
from pathlib import Path
from typing import Any

import torch
from ray import tune
from ray.tune.schedulers import ASHAScheduler
from torch.nn.utils import parameters_to_vector

from multilift_marl._ray import check_versions, connect, disconnect
from multilift_marl._versions import find_versions
from multilift_marl.agents.trainer import new_run
from multilift_marl.config.load import load_config, parse_overrides

SAMPLERS = {"uniform": tune.uniform, "loguniform": tune.loguniform, "randint": tune.randint}
EVERY = 20  # iterations between evaluations, after each of which a trial may end
DEFAULTS = {"train.learning_rate": "loguniform(3e-4, 3e-3)", "train.epochs": "choice(1, 2, 4)"}


def fly_trial(values: dict[str, Any], recipe: str, iterations: int, folder: str, versions: dict[str, str]) -> None:
    """Train one candidate and report its evaluations; `versions` are those of the search."""
    check_versions(versions)
    trainer = new_run(load_config(recipe, values), f"tune_{recipe}", Path(folder) / "runs")
    start = weights(trainer)
    last = min(iterations, trainer.iterations)  # train.frames may end it earlier
    while trainer.iteration < last:
        trainer.step()
        if trainer.iteration % EVERY == 0 or trainer.iteration == last:
            found = trainer.evaluate()
            trainer.save("last")
            success, error = found["eval/success_rate"], found[f"eval/{trainer.evaluator.error}"]
            tune.report({"success": success, "error": error, "score": success - error, "run": str(trainer.folder)})
    torch.save((start, weights(trainer)), trainer.folder / "weights.pt")
    trainer.rollouts.close()


def weights(trainer: Any) -> torch.Tensor:
    """Return a copy of the actor's weights as one vector."""
    return parameters_to_vector(trainer.learner.actor.parameters()).detach().clone()


def parse_space(arguments: list[str]) -> dict[str, Any]:
    """Return configuration keys with their values, or what Tune draws them from."""
    space: dict[str, Any] = {}
    for argument in arguments:
        key, _, text = argument.partition("=")
        call = re.fullmatch(r"(\w+)\((.*)\)", text)
        if call is None or call[1] not in (*SAMPLERS, "choice"):
            space |= parse_overrides([argument])
        else:
            found = [parse_overrides([f"{key}={part.strip()}"])[key] for part in call[2].split(",")]
            space[key] = tune.choice(found) if call[1] == "choice" else SAMPLERS[call[1]](*found)
    return space


def train(iterations: int = 100, horizon: int = 64, trials: int = 8, arguments: Any = None):
    """Search; return the weights of the best trial before and after its training."""
    given = list(arguments or [f"{key}={text}" for key, text in DEFAULTS.items()])
    recipe = next((each.removeprefix("config=") for each in given if each.startswith("config=")), "hover")
    sizes = {"train.horizon": horizon, "train.warmup": min(12, iterations // 10), "env.num_threads": 1}
    space = sizes | parse_space([each for each in given if not each.startswith("config=")])
    here, owns = Path.cwd(), connect("auto", 1, "ray")
    try:
        tuner = tune.Tuner(
            tune.with_parameters(
                fly_trial, recipe=recipe, iterations=iterations, folder=str(here), versions=find_versions()
            ),
            param_space=space,
            tune_config=tune.TuneConfig(
                metric="score", mode="max", num_samples=trials, scheduler=ASHAScheduler(grace_period=2)
            ),
            run_config=tune.RunConfig(storage_path=str(here / "runs" / "tune"), verbose=1),
        )
        results = tuner.fit()
    finally:
        if owns:
            disconnect()
    finished = [result for result in results if "score" in (result.metrics or {})]  # others broke
    for result in sorted(finished, key=lambda each: -each.metrics["score"]):
        searched = {key: result.config[key] for key in space if key not in sizes}
        print(f"success {result.metrics['success']:.1%}, {100 * result.metrics['error']:.2f} cm: {searched}")
    best = Path(results.get_best_result().metrics["run"])
    print(f"evaluate the best: python evaluate.py run={best}")
    return torch.load(best / "weights.pt")


if __name__ == "__main__":
    count = [each for each in sys.argv[1:] if each.isdecimal()]
    train(trials=int((count or ["8"])[0]), arguments=[each for each in sys.argv[1:] if "=" in each])
