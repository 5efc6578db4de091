"""How long a training takes to end after a signal, at moments from its first import to its last evaluation.

    python bench/stop.py [out.json] [signal=SIGTERM] [only=rollout] [twice=true]

Each moment has a training of its own, which tells when it is there; the moment "ray stopped" has one worker that does
not run any more (SIGSTOP). Run other processes beside it to see what it is on a busy machine.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SMALL = ["config=hover", "env.num_envs=64", "train.horizon=64", "train.frames=1e6", "eval.every=1", "eval.episodes=64"]
RAY = ["train.workers=2", "train.ray=local"]
_PATIENCE = 600.0  # [s] for a moment to come, and for a process to end


class Moment(NamedTuple):
    """A function that a training calls; without a place, seconds after its start."""

    place: str = ""
    delay: float = 0.0
    """[s] after the call has begun."""
    call: int = 1
    arguments: tuple[str, ...] = ()
    fresh: bool = False
    """Whether its kernels must be compiled."""


_TRAINER, _WORKERS = "multilift_marl.agents.trainer:", "multilift_marl.agents.workers:Workers."
_LLVM = "multilift_marl.kernels.compiler:Library._optimize_final_module"
MOMENTS = {
    "imports 0.2 s": Moment(delay=0.2),
    "imports 0.5 s": Moment(delay=0.5),
    "imports 1 s": Moment(delay=1.0),
    "imports 2 s": Moment(delay=2.0),
    "imports 4 s": Moment(delay=4.0),
    "building": Moment(_TRAINER + "Trainer.__init__", 0.3),
    "compiling the first": Moment(_LLVM, 0.2, fresh=True),
    "compiling the tenth": Moment(_LLVM, 0.2, 10, fresh=True),
    "compiling by Numba": Moment("multilift_marl.kernels.compiler:KernelCache._load_overload", 0.5, 20, fresh=True),
    "opening TensorBoard": Moment("multilift_marl.agents.logging:RunLog._open", 0.2),
    "first evaluation": Moment("multilift_marl.agents.evaluator:Evaluator.evaluate", 0.5),
    "first checkpoint": Moment(_TRAINER + "save_checkpoint"),
    "picture": Moment(_TRAINER + "Trainer._draw_best", 0.2),
    "rollout": Moment("multilift_marl.agents.rollouts:Rollouts.collect", 0.3),
    "second rollout": Moment("multilift_marl.agents.rollouts:Rollouts.collect", 0.3, 2),
    "update": Moment(_TRAINER + "update", 0.2),
    "second evaluation": Moment("multilift_marl.agents.evaluator:Evaluator.evaluate", 0.3, 2),
    "confirmation": Moment("multilift_marl.agents.evaluator:Evaluator._confirm", 0.1),
    "last checkpoint": Moment(_TRAINER + "save_checkpoint", 0.0, 3),
    "ray begins": Moment("multilift_marl._ray:connect", 0.5, 1, tuple(RAY)),
    "ray makes workers": Moment(_WORKERS + "_make", 0.1, 1, tuple(RAY)),
    "ray rollout": Moment(_WORKERS + "collect", 0.2, 2, tuple(RAY)),
    "ray stopped": Moment(_WORKERS + "collect", 0.5, 2, tuple(RAY)),
}


def tell(place: str, call: int) -> None:
    """Have this process write a line to a pipe when it calls a function for the `call`-th time."""
    module, _, path = place.partition(":")
    *owners, name = path.split(".")
    owner = importlib.import_module(module)
    for each in owners:
        owner = getattr(owner, each)
    function, count = getattr(owner, name), [0]

    def told(*arguments: Any, **options: Any) -> Any:
        count[0] += 1
        if count[0] == call:
            os.write(int(os.environ["STOP_PIPE"]), b"now\n")
        return function(*arguments, **options)

    setattr(owner, name, told)


def train(place: str, call: str, *arguments: str) -> int:
    """Train in this process, which tells when it is there."""
    tell(place, int(call))
    from multilift_marl.cli.train import main

    sys.argv = ["train.py", *arguments]
    return main()


def measure(name: str, number: int, twice: bool) -> dict[str, Any]:
    """Return what became of a training that got a signal."""
    moment = MOMENTS[name]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        kernels = {"NUMBA_CACHE_DIR": f"{folder}/kernels"} if moment.fresh else {}
        reading, writing = os.pipe()
        variables = {"PYTHONPATH": os.environ.get("PYTHONPATH", str(ROOT)), "STOP_PIPE": str(writing), **kernels}
        script = [__file__, "train", moment.place, str(moment.call)] if moment.place else [str(ROOT / "train.py")]
        command = [sys.executable, *script, *SMALL, *moment.arguments]
        process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, pass_fds=[writing],
            env=os.environ | variables, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip
        os.close(writing)
        if moment.place:
            os.read(reading, 4)
        time.sleep(moment.delay)
        if name == "ray stopped":
            stop_worker(process.pid)
        begin = time.perf_counter()
        process.send_signal(number)
        if twice:
            time.sleep(0.5)
            process.send_signal(number)
        try:
            output, _ = process.communicate(timeout=_PATIENCE)
        finally:
            process.kill()
            os.close(reading)
        seconds = time.perf_counter() - begin
        kept = any(Path(folder).glob("runs/*/checkpoints/last.pt"))
    last = output.replace("\r", "\n").strip().splitlines()[-1:]
    return {"seconds": seconds, "status": process.returncode, "checkpoint": kept, "said": last}


def stop_worker(pid: int) -> None:
    """Stop one worker of a training."""
    import psutil  # type: ignore[import-untyped]

    workers = [each for each in psutil.Process(pid).children(recursive=True) if "_Worker" in " ".join(each.cmdline())]
    workers[0].suspend()


def main(arguments: list[str]) -> None:
    """Measure all moments, print a line for each, and write them to a file if one is given."""
    options = dict(each.split("=", 1) for each in arguments if "=" in each)
    number = getattr(signal, options.get("signal", "SIGINT"))
    found = {}
    for name in MOMENTS:
        if options.get("only", "") in name:
            found[name] = measure(name, number, options.get("twice") == "true")
            print(f"{name:<22} {found[name]['seconds']:7.1f} s  {found[name]}", flush=True)
    for file in (each for each in arguments if "=" not in each):
        Path(file).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["train"]:
        sys.exit(train(*sys.argv[2:]))
    main(sys.argv[1:])
