"""May learning be coarser and wider, as an accelerator wants it?

Trains preset `default` over MuJoCo's C engine on CPU cores and judges what comes out:
  TF32, bfloat16   the factors of all products of the network's layers, forward and backward, are
                   rounded to as many bits as GPUs and TPUs keep of them, summed in float32;
  more boards      sized as on an accelerator: batches, replay and decisions grow with the boards.

    python benchmarks/precision.py [--seeds 0 1] [--write benchmarks/README.md]
"""

import argparse
import contextlib
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

from markers import publish, table
from throughput import hardware

from mjx_balance.quiet import quiet_imports

with quiet_imports("torch", "warp"):
    import jax
    import jax.numpy as jnp
    import numpy as np
    from flax import linen as nn

    from mjx_balance.config import preset
    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.evaluation.rollout import evaluate
    from mjx_balance.evaluation.suites import HEADLINE
    from mjx_balance.policy.file import save_policy
    from mjx_balance.policy.manifest import make_manifest
    from mjx_balance.training import sizing

MANTISSA = {"float32": 23, "TF32": 10, "bfloat16": 7}
"""Bits that a number keeps; its exponent stays."""
VARIANTS = (("float32", 256), ("TF32", 256), ("bfloat16", 256), ("float32", 2_048))


def rounded_product(bits: int) -> Any:
    """(..., n) @ (n, m) of factors with so many bits, and so its gradients."""

    def kept(x: jax.Array) -> jax.Array:
        return jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=bits)

    @jax.custom_vjp
    def product(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return kept(x) @ kept(kernel)

    def backward(factors: Any, slope: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, kernel, slope = *map(kept, factors), kept(slope)
        return slope @ kernel.T, jnp.einsum("...i,...j->ij", x, slope)

    product.defvjp(lambda x, kernel: (product(x, kernel), (x, kernel)), backward)
    return product


def with_products_of(bits: int) -> Any:
    """A context in which dense layers are traced with rounded factors."""
    product = rounded_product(bits)

    def layer(next_one: Any, args: Any, kwargs: Any, context: Any) -> Any:
        if isinstance(context.module, nn.Dense) and context.method_name == "__call__":
            how = lambda x, kernel, *_, **__: product(x, kernel)  # noqa: E731
            object.__setattr__(context.module, "dot_general", how)
        return next_one(*args, **kwargs)

    return nn.intercept_methods(layer) if bits < 23 else contextlib.nullcontext()


def results(precision: str, num_envs: int, seed: int, scenarios: int) -> list[dict[str, Any]]:
    """Evaluations of one training in the headline suites."""
    config = dataclasses.replace(preset("default"), engine="mujoco")
    config = sizing.size_to_device(sizing.widened(config, num_envs))
    env = BalanceEnv(config)
    learner = sizing.make_learner(config, env)
    with with_products_of(MANTISSA[precision]):
        program, state = learner.train_program(8), learner.init(seed)
        for _ in range(-(-config.num_env_steps // (8 * num_envs))):
            state, _ = jax.block_until_ready(program(state))
    params = jax.device_get(learner.exported(state))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.safetensors"
        policy = save_policy(path, params, make_manifest(config, env.scene.hash, {}))
    return [evaluate(policy, suite, scenarios, 60.0, seed=7_000_000) for suite in HEADLINE]


def main() -> None:
    """Trains, judges and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--scenarios", type=int, default=64)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    sizing.configure_jax(print)
    rows = []
    for precision, num_envs in VARIANTS:
        each = [results(precision, num_envs, seed, args.scenarios) for seed in args.seeds]
        cells = [precision, f"{num_envs:,}"]
        for one_suite in zip(*each, strict=True):
            tilts = [result["tilt_deg"] for result in one_suite]
            cells.append(str(sum(result["falls"] for result in one_suite)))
            cells += [f"{np.mean([tilt[key] for tilt in tilts]):.3f}" for key in ("mean", "p95")]
            cells.append(f"{max(tilt['max'] for tilt in tilts):.3f}")
        rows.append(cells)
        print(*cells, flush=True)
    columns = ["products", "boards"]
    for suite in HEADLINE:
        columns += [f"`{suite}`: falls", "mean", "p95", "max"]
    note = (
        f"Preset default, engine mujoco, {hardware()['cpu']}, seeds {args.seeds}; {args.scenarios} "
        "held-out scenarios of 60 s per suite and seed, tilt in deg: means over the seeds, their "
        "sum of falls and greatest max."
    )
    publish("precision", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
