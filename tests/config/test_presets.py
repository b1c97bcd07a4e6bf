"""What the presets and their flags amount to: gradient steps, replayed transitions, schedules."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest

from mjx_balance.config import PRESETS, Config, ConfigError, check, flatten, preset, to_dict
from mjx_balance.training.sizing import size_to_device


def with_dqn(config: Config, **changes: float) -> Config:
    return dataclasses.replace(config, dqn=dataclasses.replace(config.dqn, **changes))


def test_the_papers_dqn_takes_one_gradient_step_per_decision() -> None:
    """200,000 of 1e-5, as a DQN would; version 0.1 made 3,100."""
    config = preset("paper")
    assert config.num_envs is not None
    assert config.dqn.updates_per_step(config.num_envs) == config.num_envs
    assert config.dqn.target_update_period == 1_000
    assert config.dqn.batch_size == 32


@pytest.mark.parametrize(
    ("name", "samples"), [("default", 32), ("best", 64), ("quick", 128), ("smoke", 32)]
)
@pytest.mark.parametrize("num_envs", [None, 64, 512, 2_048])
def test_the_replay_ratio_does_not_depend_on_the_number_of_envs(
    name: str, samples: int, num_envs: int | None
) -> None:
    wanted = dataclasses.replace(preset(name), num_envs=num_envs)
    config = size_to_device(wanted)
    assert config.num_envs is not None
    updates = config.dqn.updates_per_step(config.num_envs)
    assert updates * config.dqn.batch_size == samples * config.num_envs
    assert config.dqn == wanted.dqn, "nothing that a user set was changed"


def test_a_ratio_that_makes_no_whole_number_of_updates_is_refused() -> None:
    config = dataclasses.replace(preset("default"), num_envs=100)
    with pytest.raises(ConfigError, match=r"replay_ratio is 32: with num_envs 100 .* 12\.5"):
        check(config)


def test_a_learning_rate_alone_changes_no_schedule() -> None:
    """The paper's rate is constant, whatever it is."""
    from mjx_balance.dqn.dqn import make_optimizer

    config = with_dqn(preset("paper"), learning_rate=1e-3, max_grad_norm=1e9)
    optimizer = make_optimizer(config.dqn, 10)
    params = np.zeros(1, np.float32)
    state = optimizer.init(params)
    sizes = []
    for _ in range(12):
        updates, state = optimizer.update(np.ones(1, np.float32), state, params)
        sizes.append(float(np.abs(np.asarray(updates))[0]))
    np.testing.assert_allclose(sizes, 1e-3, rtol=1e-4)  # Adam of a constant gradient: the rate


@pytest.mark.parametrize("name", PRESETS)
def test_presets_fit_any_number_of_envs_that_their_batch_divides(name: str) -> None:
    config = preset(name)
    for num_envs in (64, 256, 2_048):
        check(dataclasses.replace(config, num_envs=num_envs))


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("default", "e82bd94e"),
        ("best", "21701f43"),
        ("quick", "5e04fda4"),
        ("smoke", "51dacd1d"),
    ],
)
def test_presets_are_those_that_results_were_measured_with(name: str, digest: str) -> None:
    """Digests of what differs from the paper: who means to change it, changes it here."""
    bare, own = (flatten(to_dict(config)) for config in (Config(), preset(name)))
    changed = {field: value for field, value in own.items() if value != bare[field]}
    found = hashlib.sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()[:8]
    assert found == digest, changed
