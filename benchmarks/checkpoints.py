"""How long does a run stand still for a checkpoint, and how long to get going again?

Saves and restores the whole state of a run of each preset, its replay included, as `train.py` does
on CPU devices.

    python benchmarks/checkpoints.py [--presets default best] [--write benchmarks/README.md]
"""

import argparse
import dataclasses
import statistics
import tempfile
import time
from pathlib import Path

from markers import publish, table
from throughput import hardware

from mjx_balance.quiet import quiet_imports

with quiet_imports("torch", "warp"):
    import jax

    from mjx_balance.config import preset
    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.training import checkpoints, sizing


def seconds(name: str, rounds: int) -> tuple[int, float, float]:
    """Bytes of a preset's state, and medians of the times to save and to restore it."""
    config = sizing.size_to_device(dataclasses.replace(preset(name), engine="mujoco"))
    learner = sizing.make_learner(config, BalanceEnv(config))
    state = jax.block_until_ready(learner.init(0))
    saving, restoring = [], []
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "checkpoints"
        for k in range(rounds):
            began = time.perf_counter()
            checkpoints.save(folder, k, state)
            saving.append(time.perf_counter() - began)
            began = time.perf_counter()
            jax.block_until_ready(checkpoints.restore(folder, state, print))
            restoring.append(time.perf_counter() - began)
    size = sum(x.nbytes for x in jax.tree.leaves(state))
    return size, statistics.median(saving), statistics.median(restoring)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--presets", nargs="+", default=["default", "best"])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    sizing.configure_jax(print)
    rows = []
    for name in args.presets:
        size, save, restore = seconds(name, args.rounds)
        rows.append([f"`{name}`", f"{size / 2**20:.0f} MiB", f"{save:.2f} s", f"{restore:.2f} s"])
    machine = hardware()
    note = f"{machine['cpu']}, {machine['cores']} cores; medians of {args.rounds}."
    columns = ["preset", "state", "save", "restore"]
    publish("checkpoints", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
