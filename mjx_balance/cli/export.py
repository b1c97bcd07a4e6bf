"""`mjx-balance export`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from mjx_balance.cli.common import complain
from mjx_balance.errors import how_to_install
from mjx_balance.policy.file import load_policy


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a policy as an ONNX model. Needs the package onnx, and no JAX."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Policy file, run folder, or the name of a shipped policy."""
    out: Path
    """File to write, NAME.onnx."""


def export(argv: list[str]) -> int:
    args = tyro.cli(ExportArgs, args=argv, prog="mjx-balance export")
    if args.out.suffix != ".onnx":
        return complain(f"out is {args.out}; its name must end in .onnx")
    try:
        from mjx_balance.policy.onnx import OPSET, export_onnx
    except ImportError as error:
        return complain(f"export needs the package onnx ({error}); {how_to_install('onnx')}")
    policy = load_policy(args.policy)
    size = export_onnx(policy, args.out)
    print(f"{args.out}: {size / 1000:,.1f} kB, opset {OPSET}")
    print(
        f"observation (N, {policy.observation_size}) float32 -> "
        f"q_values (N, {len(policy.actions)}) float32, action (N,) int64"
    )
    return 0
