"""Install each example into its own environment, train a little, and check that the weights changed.

Run: python examples/check.py [name ...] [folder=PATH]      (in PATH the environments are made, and deleted after use)
Prints one line for each example: result, seconds of installing and of running, versions; exit status 1 if one failed.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
NAMES = sorted(path.stem for path in (HERE / "requirements").glob("*.txt"))
SIZES = {"iterations": 2, "horizon": 32}
PACKAGES = (
    "stable_baselines3", "supersuit", "ray", "skrl", "tianshou", "benchmarl", "torchrl", "tensordict", "torch",
    "gymnasium", "pettingzoo", "numpy", "tensorboard", "tqdm", "matplotlib", "imageio", "av",
)  # fmt: skip
INSIDE = """
import importlib, importlib.metadata as metadata, json, sys
name, sizes, packages = json.loads(sys.argv[1])
before, after = importlib.import_module(name).train(**sizes)
installed = {part.metadata["Name"].lower().replace("-", "_"): part.version for part in metadata.distributions()}
moved = float((after - before).norm(dim=-1).min())  # of several policies, one a row, that which moved least
result = {"finite": bool(before.isfinite().all() and after.isfinite().all()), "moved": moved}
result |= {"weights": before.numel(), "versions": {key: installed[key] for key in packages if key in installed}}
print("\\n" + json.dumps(result))
"""


def install(name: str, folder: Path) -> Path:
    """Make a virtual environment with the package and the requirements of an example; return its Python."""
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    requirements = HERE / "requirements" / f"{name}.txt"
    run([python, "-m", "pip", "install", "-q", "-e", HERE.parent, "-r", requirements], folder)
    return python


def try_out(python: str | Path, name: str, folder: Path, **sizes: int) -> dict[str, Any]:
    """Train an example for some short iterations by a Python that has what it needs.

    Args:
        python: the interpreter.
        name: of the example.
        folder: where it runs, and leaves what its trainer writes.
        **sizes: arguments of its `train` beside SIZES.

    Returns:
        `weights` (how many), `moved` (the norm of their change, of several policies the least) and `versions`
        {package: version}.

    Raises:
        RuntimeError: it failed, or its weights stayed as they were or are not finite.
    """
    job = json.dumps([name, SIZES | sizes, PACKAGES])
    result = json.loads(run([python, "-c", INSIDE, job], folder).splitlines()[-1])
    if not result.pop("finite") or not result["moved"] > 0:
        raise RuntimeError(f"the weights of {name} moved by {result['moved']}")
    return result


def run(command: list[str | Path], folder: Path) -> str:
    """Return what a command prints; raise RuntimeError with its last lines if it fails."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)
    if done.returncode:
        raise RuntimeError("\n".join((done.stdout + done.stderr).strip().splitlines()[-15:]))
    return done.stdout


def check(name: str, parent: str | None) -> bool:
    """Install and try out one example in a temporary folder in `parent`; print its line of checked.csv."""
    with tempfile.TemporaryDirectory(prefix=f"{name}-", dir=parent) as folder:
        start = time.perf_counter()
        try:
            python = install(name, Path(folder))
            installed = time.perf_counter()
            result = try_out(python, name, Path(folder))
        except RuntimeError as error:
            print(f"{name},failed,,,,\n{error}", flush=True)
            return False
        seconds = f"{installed - start:.0f},{time.perf_counter() - installed:.0f}"
    versions = ", ".join(f"{package} {version}" for package, version in result["versions"].items())
    print(f'{name},{result["weights"]},{result["moved"]:.2f},{seconds},"{versions}"', flush=True)
    return True


def main(arguments: list[str]) -> int:
    """Check the named examples, or all."""
    parent = next((word.removeprefix("folder=") for word in arguments if word.startswith("folder=")), None)
    names = [word for word in arguments if "=" not in word] or NAMES
    for name in names:
        if name not in NAMES:
            print(f"error: no example '{name}'; known: {', '.join(NAMES)}", file=sys.stderr)
            return 2
    print("example,weights,norm_of_change,installing_s,training_s,versions", flush=True)
    return 0 if all([check(name, parent) for name in names]) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
