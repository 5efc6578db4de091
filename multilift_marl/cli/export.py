"""`python -m multilift_marl.export run=latest`, installed as `multilift-export`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from multilift_marl._interrupt import ending_at_once
from multilift_marl.command import CommandOptions, make_folder, run_command, split_options
from multilift_marl.errors import ConfigError
from multilift_marl.schema.values import Between, Int

_USAGE = """Write a trained policy as an ONNX network and a contract of its inputs and outputs (docs/export.md).

  python -m multilift_marl.export run=latest [out=<folder>] [opset=18]

import=<module> says where a module of one's own is that the run was trained with."""


class Options(CommandOptions):
    """Keys of the command."""

    run: str = Field("latest", description='a run folder, "latest", a checkpoint file, or a shipped policy ("hover")')
    out: str | None = Field(
        None, description="folder for policy.onnx and policy.json; None: <run>/export, runs/shipped-<name>/export"
    )
    opset: Annotated[Int | None, Between(7, 100)] = Field(
        None, description="version of ONNX's operators, for an older runtime; None: the exporter's own"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Export; return the exit status."""
    with ending_at_once() if arguments is None else nullcontext():
        return run_command(_export, _USAGE, Options, arguments, configuration=None)


def _export(values: dict[str, Any]) -> int:
    options, others = split_options(Options, values)
    for key in others:
        if key != "import":
            raise ConfigError(f"a trained policy keeps its configuration: leave out {key}, or train with it")
    from multilift_marl.agents.export import CONTRACT, NETWORK, export_policy
    from multilift_marl.agents.policy import load_policy

    policy = load_policy(options.run)
    out = make_folder(policy.folder / "export" if options.out is None else Path(options.out))
    contract = export_policy(policy, out, options.opset)
    sizes = [len(contract["observation"]["names"]), len(contract["action"]["numbers"])]
    print(
        f"{policy.source}: {contract['task']}, {sizes[0]} numbers to {sizes[1]} for each drone, "
        f"{contract['policy_hz']:g} times a second\n"
        f"wrote {out / NETWORK} and {out / CONTRACT}; actions within "
        f"{contract['network']['largest_difference']:.0e} of torch's"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
