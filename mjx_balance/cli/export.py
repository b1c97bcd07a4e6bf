"""`mjx-balance export`."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from mjx_balance.cli.common import complain
from mjx_balance.errors import PATH, how_to_install, shorten
from mjx_balance.evaluation.rollout import policy_scene
from mjx_balance.policy.c_header import export_header
from mjx_balance.policy.file import convert_policy, find_policy, read_policy, upgrade_policy
from mjx_balance.policy.manifest import FORMAT_VERSION, naming, upgrade
from mjx_balance.policy.network import Policy


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a policy as ONNX (extra onnx), as a controller in C, or in the current format."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Policy file, run folder, or the name of a shipped policy."""
    out: Path
    """File to write: NAME.onnx, NAME.h, or NAME.safetensors in the current format."""
    action: Literal["grid", "continuous"] | None = None
    """Height changes to command: those of the grid, or any up to the greatest of them; none: as the
    policy was trained."""
    trim: bool = False
    """Add the feed-forward torques that bear the robot's weight: measure in simulation how far the
    servos must aim beyond their targets. Newly trained policies have them already."""
    stateful: bool = False
    """Write the whole controller as ONNX: a sample of the sensors and a state go in, joint targets
    and the next state come out. Without this flag, an ONNX model is the network alone, from
    observations to commands."""


def export(argv: list[str]) -> int:
    args = tyro.cli(ExportArgs, args=argv, prog="mjx-balance export")
    writers = {".onnx": _write_onnx, ".h": _write_header, ".safetensors": _write_safetensors}
    if args.out.suffix not in writers:
        out = shorten(args.out, PATH)
        return complain(f"out is {out}; its name must end in .onnx, .h or .safetensors")
    if args.stateful and args.out.suffix != ".onnx":
        return complain(
            f"stateful is set, but out is {shorten(args.out, PATH)}; only a model in .onnx can be "
            "stateful"
        )
    return writers[args.out.suffix](args)


def _write_onnx(args: ExportArgs) -> int:
    try:
        from mjx_balance.policy.onnx import OPSET, export_onnx
        from mjx_balance.policy.onnx_controller import export_controller
    except ImportError as error:
        return complain(f"export needs the package onnx ({error}); {how_to_install('onnx')}")
    if args.stateful:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "policy"
            legs = len(_convert(args, path).manifest["robot"]["legs"])
            size, values = export_controller(path, args.out)
        about = (
            f"joint_positions ({legs}, 3), gyro (3,), accelerometer (3,), state ({values},) "
            f"float64 -> targets ({legs}, 3), command (2,) float64, decided () bool, "
            f"next_state ({values},) float64"
        )
    else:
        policy = Policy(*upgrade_policy(*_source(args)))
        size = export_onnx(policy, args.out)
        about = (
            f"observation (N, {policy.observation_size}) float32 -> q_values "
            f"(N, {len(policy.actions)}) float32, action (N,) int64, command (N, 2) float32"
        )
    print(f"{shorten(args.out, PATH)}: {size / 1000:,.1f} kB, opset {OPSET}")
    print(about)
    return 0


def _write_safetensors(args: ExportArgs) -> int:
    policy = _convert(args, args.out)
    size, file = args.out.stat().st_size, shorten(args.out, PATH)
    print(f"{file}: {size / 1000:,.1f} kB, format {FORMAT_VERSION}, weights {policy.fingerprint}")
    return 0


def _write_header(args: ExportArgs) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy"
        policy = _convert(args, path)
        size = export_header(path, args.out, policy.fingerprint)
    print(f"{shorten(args.out, PATH)}: {size / 1000:,.1f} kB, C99, weights {policy.fingerprint}")
    return 0


def _convert(args: ExportArgs, out: Path) -> Policy:
    path, action, leg_trim = _source(args)
    return convert_policy(path, out, action, leg_trim)


def _source(args: ExportArgs) -> tuple[Path, str | None, np.ndarray | None]:
    """The policy's file, and what changes."""
    path = find_policy(args.policy)
    return path, args.action, _leg_trim(path) if args.trim else None


def _leg_trim(path: Path) -> np.ndarray:
    """(legs, 3) trim of the scene of a policy of format 4 or 5, rad."""
    manifest, weights = read_policy(path)
    with naming(path):
        return policy_scene(Policy(upgrade(manifest), weights)).stance.leg_trim
