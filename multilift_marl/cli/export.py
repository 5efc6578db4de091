"""`python -m multilift_marl.export run=latest`, installed as `multilift-export`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multilift_marl.cli.common import make_folder, run_command
from multilift_marl.errors import ConfigError

_USAGE = """Write a trained policy as an ONNX network and a contract of its inputs and outputs (docs/export.md).

  python -m multilift_marl.export run=latest [out=<folder>]

  run   a run folder (its best checkpoint), "latest", a checkpoint file, or the name of a shipped policy     (latest)
  out   folder for policy.onnx and policy.json         (<run>/export, of a shipped policy runs/shipped-<name>/export)
  import  where a module of one's own is now, that the run was trained with"""

_DEFAULTS = {"run": "latest", "out": None, "import": None}


def main(arguments: Sequence[str] | None = None) -> int:
    """Export; return the exit status."""
    return run_command(_export, _USAGE, _DEFAULTS, arguments, configuration=None, names=_DEFAULTS)


def _export(values: dict[str, Any]) -> int:
    for key in values:
        if key not in _DEFAULTS:
            raise ConfigError(f"a trained policy keeps its configuration: leave out {key}, or train with it")
    own = _DEFAULTS | values
    from multilift_marl.agents.export import CONTRACT, NETWORK, export_policy

    policy, home = _find_policy(str(own["run"]))
    out = make_folder(Path(own["out"]) if own["out"] is not None else home / "export")
    contract = export_policy(policy, out)
    sizes = [len(contract["observation"]["names"]), len(contract["action"]["numbers"])]
    print(
        f"{policy.source}: {contract['task']}, {sizes[0]} numbers to {sizes[1]} for each drone, "
        f"{contract['policy_hz']:g} times a second\n"
        f"wrote {out / NETWORK} and {out / CONTRACT}; actions within "
        f"{contract['network']['largest_difference']:.0e} of torch's"
    )
    return 0


def _find_policy(run: str) -> tuple[Any, Path]:
    """Return the policy and the folder that it belongs to."""
    from multilift_marl.agents.checkpoint import find_run
    from multilift_marl.agents.policy import load_policy, shipped_policies

    if run in shipped_policies() and not os.path.exists(run):
        return load_policy(run), Path("runs") / f"shipped-{run}"
    if os.path.isfile(run):
        return load_policy(run), Path(run).parent
    folder = find_run(run)
    return load_policy(folder), folder


if __name__ == "__main__":
    sys.exit(main())
