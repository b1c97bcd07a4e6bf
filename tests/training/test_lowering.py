"""The training program of engine `mjx`, lowered for the accelerators that no test machine has."""

import dataclasses
import re
from typing import Any

import jax
import pytest
from jax import export

from mjx_balance.config import preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.training.sizing import make_learner, size_to_device

KERNELS = {
    "cuda": {"cusolver_potrf_ffi", "cusolver_syevd_ffi"},
    "tpu": {"Eigh"},
}
"""Platform -> custom calls of its own: MJX's Cholesky, and the whitening's eigenvalues."""


@pytest.mark.slow
@pytest.mark.parametrize("platform", KERNELS)
def test_the_training_program_is_lowered(platform: str) -> None:
    config = size_to_device(
        dataclasses.replace(preset("smoke"), engine="mjx", num_envs=2_048, num_devices=1)
    )
    learner = make_learner(config, BalanceEnv(config))
    state = jax.eval_shape(lambda: learner.init(0))
    program: Any = learner.train_program(2)
    exported = export.export(program, platforms=[platform])(state)
    assert exported.platforms == (platform,)
    calls = set(re.findall(r"custom_call @(\w+)", exported.mlir_module()))
    assert calls - {"Sharding", "SPMDFullToShardShape", "SPMDShardToFullShape"} == KERNELS[platform]
