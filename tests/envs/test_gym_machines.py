"""Gymnasium's envs in the hands of others: copied, pickled, in other processes, wrapped."""

import copy
import dataclasses
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector

from mjx_balance.config import Config, ConfigError, preset

ENV = "mjx_balance/Balance-v0"
COPIES: list[Callable[[Any], Any]] = [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]


@pytest.fixture(scope="module")
def config() -> Config:
    """Sensor noise, payloads, delays and pushes; episodes of 7 decisions."""
    config = preset("best")
    task = dataclasses.replace(config.task, action="grid", episode_length=7)
    ranges = dataclasses.replace(config.randomization, payload=5.0, latency_share=0.5)
    return dataclasses.replace(config, task=task, randomization=ranges)


def actions(count: int, size: tuple[int, ...] = ()) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 441, (count, *size))


def assert_same(one: Any, other: Any) -> None:
    """Nested tuples and dicts of arrays, exactly equal."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        one, other = list(one.values()), [other[name] for name in one]
    if isinstance(one, list | tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        assert len(one) == len(other)
        for x, y in zip(one, other, strict=True):
            assert_same(x, y)
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("make_copy", COPIES, ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("count", [0, 3], ids=["one", "many"])
def test_a_copy_goes_on_as_the_original(make_copy: Any, count: int, config: Config) -> None:
    """Through the end of an episode, with the same sensor noise; neither notices the other."""
    if count:
        env, size = gymnasium.make_vec(ENV, count, config=config), (count,)
    else:
        env, size = gymnasium.make(ENV, config=config), ()
    moves = actions(12, size)
    env.reset(seed=3)
    for move in moves[:4]:
        env.step(move)
    twin = make_copy(env)
    seen = []
    for own in (env, twin):
        steps = [own.step(move) for move in moves[4:7]]
        begin = [] if count else [own.reset()]
        seen.append([*steps, *begin, *(own.step(move) for move in moves[7:])])
    assert_same(*seen)


@pytest.mark.parametrize("make_copy", COPIES, ids=["deepcopy", "pickle"])
def test_an_env_can_be_copied_before_its_first_reset(make_copy: Any, config: Config) -> None:
    env = gymnasium.make(ENV, config=config)
    assert_same(env.reset(seed=1), make_copy(env).reset(seed=1))


def test_a_copy_has_a_process_that_draws_of_its_own(config: Config) -> None:
    env: Any = gymnasium.make(ENV, config=config, render_mode="rgb_array").unwrapped
    env._painter = painter = type("Painter", (), {"close": lambda self: None})()
    assert copy.deepcopy(env)._painter is None
    assert env._painter is painter


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_episodes_restart_as_gymnasium_restarts_them(mode: str, config: Config) -> None:
    """Its own vector env, over single envs, is the reference: every value of 20 steps."""
    ours: Any = gymnasium.make_vec(ENV, 3, config=config, autoreset_mode=mode)
    theirs: Any = gymnasium.make_vec(
        *(ENV, 3, "sync"), config=config, vector_kwargs={"autoreset_mode": mode}
    )
    assert ours.metadata["autoreset_mode"] is AutoresetMode(mode)
    assert_same(ours.reset(seed=4), theirs.reset(seed=4))
    ended = 0
    for move in actions(20, (3,)):
        step = ours.step(move)
        assert_same(step[:4], theirs.step(move)[:4])
        done = step[2] | step[3]
        ended += done.sum()
        if mode == "Disabled" and done.any():
            assert_same(*(x.reset(options={"reset_mask": done.copy()})[0] for x in (ours, theirs)))
    assert ended >= 6


def test_an_env_that_restarts_has_no_tilt(config: Config) -> None:
    envs: Any = gymnasium.make_vec(ENV, 2, config=config, autoreset_mode="NextStep")
    envs.reset(seed=0)
    for _ in range(6):
        envs.step(np.full(2, 220))
    _, _, _, truncated, info = envs.step(np.full(2, 220))
    assert truncated.all()
    assert info["_tilt_deg"].all()
    _, reward, terminated, truncated, info = envs.step(np.full(2, 220))
    assert not (info["_tilt_deg"] | info["_fall"] | terminated | truncated).any()
    assert (reward == 0).all()


def test_disabled_envs_wait_for_a_reset(config: Config) -> None:
    envs: Any = gymnasium.make_vec(ENV, 2, config=config, autoreset_mode="Disabled")
    masks = [np.zeros(2, bool), np.ones(3, bool), np.ones(2), [[True]], None]
    with pytest.raises(ResetNeeded, match="before the first reset"):
        envs.reset(options={"reset_mask": np.asarray([True, False])})
    envs.reset(seed=0)
    for mask in masks:
        with pytest.raises(ValueError, match=r"options is .*; it must be None or \{\}, or"):
            envs.reset(options={"reset_mask": mask})
    for _ in range(7):
        envs.step(np.full(2, 220))
    with pytest.raises(ResetNeeded):
        envs.step(np.full(2, 220))
    with pytest.raises(ConfigError, match="must be one of 'NextStep', 'SameStep', 'Disabled'"):
        gymnasium.make_vec(ENV, 2, autoreset_mode="Never")


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # Gymnasium's own, of float64
@pytest.mark.parametrize(
    "wrapper",
    [
        vector.RecordEpisodeStatistics,
        vector.NormalizeReward,
        vector.NormalizeObservation,
        vector.FlattenObservation,
        lambda envs: vector.DtypeObservation(envs, np.float64),
        vector.DictInfoToList,
    ],
)
def test_gymnasiums_vector_wrappers_take_the_envs(wrapper: Any, config: Config) -> None:
    envs = wrapper(gymnasium.make_vec(ENV, 2, config=config, autoreset_mode="NextStep"))
    envs.reset(seed=0)
    for _ in range(9):
        envs.step(np.full(2, 220))


def test_a_spec_says_how_long_an_episode_is(config: Config) -> None:
    """7 decisions, or what the caller says; an env that is made of it ends as early."""
    one: Any = gymnasium.make(ENV, config=config)
    many: Any = gymnasium.make_vec(ENV, 2, config=config, max_episode_steps=5)
    for env, steps in ((one, 7), (gymnasium.make(one.spec), 7)):
        assert env.spec.max_episode_steps == steps
        env.reset(seed=0)
        assert [env.step(220)[3] for _ in range(steps)] == [False] * (steps - 1) + [True]
    for envs in (many, gymnasium.make_vec(many.spec)):
        assert envs.spec.max_episode_steps == 5
        envs.reset(seed=0)
        ends = [envs.step(np.full(2, 220))[3].all() for _ in range(5)]
        assert ends == [False] * 4 + [True]
    with pytest.raises(ConfigError, match="max_episode_steps is 8; it must be from 1 to 7"):
        gymnasium.make_vec(ENV, 2, config=config, max_episode_steps=8)


SPAWNED = """
import multiprocessing, sys, gymnasium
def work(pipe):
    env = pipe.recv()
    pipe.send([env.step(220)[0].tolist(), gymnasium.make(sys.argv[1]).reset(seed=0)[0].tolist()])
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    env = gymnasium.make(sys.argv[1])
    first = env.reset(seed=0)[0].tolist()
    ours, theirs = context.Pipe()
    process = context.Process(target=work, args=(theirs,))
    process.start()
    ours.send(env)
    step, reset = ours.recv()
    process.join()
    print(reset == first, step == env.step(220)[0].tolist())
"""


@pytest.mark.slow
def test_a_spawned_process_makes_and_receives_envs(tmp_path: Any) -> None:
    """The id names the module, so that a process that has imported nothing finds it."""
    script = tmp_path / "spawned.py"
    script.write_text(SPAWNED, "utf-8")
    done = subprocess.run(
        [sys.executable, str(script), f"mjx_balance:{ENV}"], capture_output=True, text=True
    )
    assert (done.stdout, done.returncode) == ("True True\n", 0), done.stderr
