"""The Gymnasium envs: what Gymnasium asks for, and the task of `BalanceEnv`."""

import dataclasses
import functools
import runpy
import subprocess
import sys
import types
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from gymnasium.error import InvalidAction, ResetNeeded, UnsupportedMode
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from mjx_balance.config import Config, ConfigError, RandomizationConfig, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.envs.batch import BatchEnv, Episodes, draw_episodes
from mjx_balance.envs.gym import BalanceGymEnv, BalanceVecEnv
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.rollout import roll_out
from mjx_balance.render import drawing as render
from mjx_balance.render.drawing import RenderError
from mjx_balance.robots.catalogue import Robot
from mjx_balance.robots.limits import for_robot

ENV = "mjx_balance/Balance-v0"
STAND, LEFT_UP = 220, 20 * 21 + 10
SCORE = {"dqn": 0.4, "ppo": 0.15}
"""Mean tilt, deg, that learning has to get below; `docs/other_algorithms.md` has the results."""
EXAMPLE = Path(__file__).parents[2] / "examples" / "train_sb3.py"
RANDOM = RandomizationConfig(
    payload=5.0, friction_min=0.5, gain_spread=0.2, latency_share=0.5, push_max=0.2, push_period=2.0
)


@pytest.fixture
def env() -> Iterator[Any]:
    """As `gymnasium.make` makes it."""
    made = gymnasium.make(ENV)
    yield made
    made.close()


class Screen:
    """Stands for MuJoCo's viewer, which needs a display."""

    def __init__(self, model: Any, data: Any, **looks: Any):
        self.data, self.shown, self.open = data, [], True
        self.cam = types.SimpleNamespace()

    def is_running(self) -> bool:
        return self.open

    def lock(self) -> Any:
        return warnings.catch_warnings()  # any context would do

    def sync(self) -> None:
        self.shown.append(self.data.qpos.copy())

    def close(self) -> None:
        self.open = False


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> list[Screen]:
    """The windows that are opened."""
    import mujoco.viewer

    opened = []

    def launch(*args: Any, **looks: Any) -> Screen:
        opened.append(Screen(*args, **looks))
        return opened[-1]

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    monkeypatch.setattr(render, "_check_display", lambda: None)
    return opened


def random_actions(seed: int, count: int, most: int = 2) -> np.ndarray:
    """Indices (count,) of up to `most` levels on both axes."""
    levels = 10 + np.random.default_rng(seed).integers(-most, most + 1, (count, 2))
    return levels[:, 0] * 21 + levels[:, 1]


def walk(env: Any, actions: np.ndarray, seed: int) -> list[Any]:
    """What reset and steps return until the episode ends."""
    seen: list[Any] = [env.reset(seed=seed)]
    for action in actions:
        seen.append(env.step(action))
        if seen[-1][2] or seen[-1][3]:
            break
    return seen


def short(config: Config, decisions: int, **task: Any) -> Config:
    """The same with episodes of so many decisions."""
    task = {"episode_length": decisions} | task
    return dataclasses.replace(config, task=dataclasses.replace(config.task, **task))


@pytest.mark.parametrize("kind", ["discrete", pytest.param("continuous", marks=pytest.mark.slow)])
def test_gymnasium_finds_nothing_to_warn_of(kind: str, screen: list[Screen]) -> None:
    """Warnings are errors here; every render mode is tried."""
    env = gymnasium.make(ENV, action=kind)
    try:
        check_env(env.unwrapped)
    except RenderError as error:
        pytest.skip(str(error))
    assert len(screen) == 1
    assert not screen[0].open


@pytest.mark.slow
def test_the_package_is_enough_whichever_is_imported_first() -> None:
    """A process that has imported neither, as a spawned worker, names the module in the id."""
    for lines, env_id in (
        ("import gymnasium, mjx_balance", ENV),
        ("import mjx_balance; import gymnasium", ENV),
        ("import gymnasium", f"mjx_balance:{ENV}"),
    ):
        make = f"gymnasium.make({env_id!r}).unwrapped, gymnasium.make_vec({env_id!r})"
        said = f"import sys; {lines}; print({make}, 'jax' in sys.modules)"
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", said], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert "BalanceGymEnv" in done.stdout
        assert "BalanceVecEnv" in done.stdout
        assert done.stdout.split()[-1] == "False"


def test_a_broken_gymnasium_says_so_itself(tmp_path: Path) -> None:
    (tmp_path / "gymnasium.py").write_text("raise RuntimeError('broken')")
    command = "import sys; sys.path.insert(0, sys.argv[1]); import mjx_balance, gymnasium"
    done = subprocess.run(
        [sys.executable, "-c", command, str(tmp_path)], capture_output=True, text=True
    )
    assert done.stderr.strip().endswith("RuntimeError: broken")


def test_equal_seeds_equal_episodes(env: Any) -> None:
    actions = random_actions(0, 40)
    first, again, other = (walk(env, actions, seed) for seed in (4, 4, 5))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
        assert a[1:] == b[1:]
    assert np.abs(first[10][0] - other[10][0]).max() > 0.01
    env.reset(seed=4)
    env.reset()
    assert np.abs(env.step(STAND)[0] - first[1][0]).max() > 1e-6, "no episode comes twice"


@functools.cache
def compiled(config: Config) -> tuple[Any, Any]:
    """Reset and step of `BalanceEnv`."""
    env = BalanceEnv(config)
    return jax.jit(env.reset), jax.jit(env.step)


def driven(config: Config, batch: BatchEnv, actions: np.ndarray) -> list[Any]:
    """States of `BalanceEnv` in the episode of a batch's only env."""
    reset, step = compiled(config)
    state: Any = reset(jax.random.PRNGKey(0))
    start, theirs = state.pipeline_state, batch.state
    given = {name: getattr(theirs, name) for name in ("scenario", "params", "pushes")}
    given = jax.tree.map(
        lambda x, own: jnp.asarray(x[0], own.dtype),
        given,
        {name: getattr(start, name) for name in given},
    )
    states = [state.replace(pipeline_state=start._replace(**given))]
    for action in actions:
        states.append(step(states[-1], jnp.int32(action)))
    return jax.device_get(states)


@pytest.mark.parametrize("ranges", [RandomizationConfig(), RANDOM], ids=["nominal", "random"])
@pytest.mark.parametrize("falls", [False, True])
def test_an_episode_is_that_of_balance_env(
    config: Config, ranges: RandomizationConfig, falls: bool
) -> None:
    """Between decisions its state is float32: 6e-8 of an IMU in units of 1 deg comes to 1e-4."""
    config = dataclasses.replace(short(config, 40), engine="mujoco", randomization=ranges)
    env = BalanceGymEnv(config=config)
    delays = []
    for seed in (1, 2):
        actions = np.full(40, LEFT_UP) if falls else random_actions(seed, 40, 1)
        seen = walk(env, actions, seed)
        assert env.batch is not None
        params = env.batch.state.params
        delays.append(0 if params is None else params.delay[0])
        states = driven(config, env.batch, actions[: len(seen) - 1])
        assert 5 < len(seen) < 12 if falls else len(seen) == 41
        assert seen[-1][2:4] == (falls, not falls)
        for step, state in zip(seen, states, strict=True):
            np.testing.assert_allclose(step[0], state.obs, atol=3e-4)
        for (_, reward, fell, cut, info), state in zip(seen[1:], states[1:], strict=True):
            assert reward == pytest.approx(float(state.reward), abs=5e-5)
            assert info["tilt_deg"] == pytest.approx(float(state.metrics["tilt_deg"]), abs=1e-4)
            assert fell == info["fall"] == bool(state.metrics["fall"])
            assert cut == bool(state.info["truncation"])
            assert (fell or cut) == bool(state.done)
    assert set(delays) == ({0, 1} if ranges == RANDOM else {0})


def test_every_sample_has_noise_of_its_own(config: Config) -> None:
    """The clean scenarios are the same: noise is drawn after them."""
    noise = RandomizationConfig(gyro_noise=0.002, accel_noise=0.023)
    noisy = BalanceVecEnv(64, config=dataclasses.replace(config, randomization=noise))
    clean = BalanceVecEnv(64)
    actions = np.full(64, STAND)
    differences = []
    for env in (noisy, clean):
        env.reset(seed=0)
        differences.append(env.step(actions)[0])
    added = differences[0] - differences[1]
    assert not added[:, :4].any(), "foot heights"
    np.testing.assert_allclose(added[:, 4:16].std(), 0.002 / np.radians(1), rtol=0.1)
    np.testing.assert_allclose(added[:, 16:].std(), 0.023 / (9.81 * 0.0174524), rtol=0.1)
    assert np.abs(np.corrcoef(added[:, 4:].T) - np.eye(30)).max() < 0.5


def test_every_episode_has_sensors_that_err_in_their_own_way(config: Config) -> None:
    """The first observation shows a bias; the second episode of an env has another."""
    ranges = RandomizationConfig(gyro_bias=0.01, encoder_offset=0.02)
    env = BalanceVecEnv(3, config=dataclasses.replace(short(config, 2), randomization=ranges))
    first = env.reset(seed=0)[0]
    stand = np.full(3, STAND)
    env.step(stand)
    second = env.step(stand)[0]  # the episodes end, and others begin
    for obs in (first, second):
        assert env.batch is not None
        assert env.batch.state.errors is not None
        assert np.ptp(obs[:, 4]) > 0.1, "deg/s"
        assert np.ptp(obs[:, 0]) > 0.1, "cm"
    np.testing.assert_allclose(
        np.radians(second[:, 4]), env.batch.state.errors.bias[:, 0], atol=1e-6
    )
    assert np.abs(first - second)[:, 4:16].max(axis=1).min() > 1e-3, "about x or y"


@pytest.mark.parametrize(("share", "square"), [(0.0, 49 / 6), (1.0, 49 / 3), (0.5, 49 / 4)])
def test_boards_are_those_of_training(
    config: Config, robot: Robot, share: float, square: float
) -> None:
    rngs = [np.random.default_rng(k) for k in range(1500)]
    own = short(config, 300, square_share=share)
    scenario = draw_episodes(own.task, own.randomization, robot, rngs).scenario
    targets, phase, rate, waves, start = scenario
    assert waves is start is None
    assert targets.shape == (1500, 7, 2)  # 60 s, whatever the phase
    assert not targets[:, 0].any()
    # x^2 of a disc's uniform radius of 7 deg: 49 / 3 / 2; of a square's side: 49 / 3.
    assert (targets[:, 1:] ** 2).mean() == pytest.approx(square, rel=0.04)
    np.testing.assert_allclose(targets[:, 1:].mean(axis=(0, 1)), 0, atol=0.2)
    # x^2 y^2: in the disc 7^4 / 5 / 8; in the square (49 / 3)^2. Both axes go together.
    both = (1 - share) * 7**4 / 40 + share * (49 / 3) ** 2
    assert (targets[:, 1:] ** 2).prod(axis=-1).mean() == pytest.approx(both, rel=0.05)
    assert (np.hypot(*targets.T).max() > 7.001) == (share > 0)
    assert scipy.stats.kstest(phase, "uniform", (0, 10)).pvalue > 1e-3
    assert set(rate) == {3.5}


@pytest.mark.parametrize("falls", [False, True])
def test_an_episode_is_that_of_the_evaluation(config: Config, falls: bool) -> None:
    """To the last bit but the observation's float32; from a fall on it counts otherwise."""
    env = BalanceGymEnv(config=short(config, 60))
    actions = np.full(60, 440) if falls else random_actions(1, 60)
    seen = walk(env, actions, 7)
    asked = []

    def recorded(view: View) -> np.ndarray:
        asked.append(view.obs[0])
        return actions[[view.env_steps]]

    rollout = roll_out(env.scene, recorded, Episodes(env.batch.state.scenario), 12.0)
    assert falls == rollout.fell[0] == seen[-1][2]
    np.testing.assert_array_equal([s[0] for s in seen[:-1]], np.asarray(asked, np.float32))
    tilt = rollout.tilt.reshape(60, 50).mean(axis=-1)[: len(seen) - 1]
    told = np.asarray([s[4]["tilt_deg"] for s in seen[1:]])
    np.testing.assert_array_equal(told[: len(tilt) - falls], tilt[: len(tilt) - falls])


def test_episodes_end_by_the_time_limit_and_then_need_a_reset(config: Config) -> None:
    env = gymnasium.make(ENV, config=short(config, 3)).unwrapped
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step"):
        env.step(STAND)
    for _ in range(2):
        env.reset()
        assert [env.step(STAND)[2:4] for _ in range(3)] == [
            (False, x) for x in (False, False, True)
        ]
        with pytest.raises(ResetNeeded, match=r"call reset\(\) before step"):
            env.step(STAND)


def test_a_fall_at_the_time_limit_is_a_fall(config: Config) -> None:
    env = BalanceGymEnv()
    ends = len(walk(env, np.full(20, LEFT_UP), 0)) - 1
    again = BalanceGymEnv(config=short(config, ends))
    # Targets of shorter episodes are fewer: the same board is given.
    again.reset(seed=0)
    again.batch.state = again.batch.state._replace(scenario=env.batch.state.scenario)
    seen = [again.step(LEFT_UP) for _ in range(ends)]
    assert seen[-1][2:4] == (True, False)


def test_a_diverged_simulation_is_a_fall() -> None:
    """Env 1 has a warning of MuJoCo alone, env 2 a NaN; after the reset both are sane again."""
    envs = BalanceVecEnv(3)
    envs.reset(seed=0)
    envs.batch._engine._batch.warning[1] = 1
    envs.batch._engine._batch.qvel[2, 11] = np.nan
    seen = [envs.step(np.full(3, STAND)) for _ in range(3)]
    assert [list(step[2]) for step in seen] == [[False, True, True], [False] * 3, [False] * 3]
    last = seen[0][4]
    assert last["final_info"]["tilt_deg"].tolist() == [0, 6, 6]
    assert last["final_obs"][2] in envs.single_observation_space
    assert (seen[0][1][1:] < -1).all()
    for obs, *_, info in seen:
        assert obs in envs.observation_space
        assert info["tilt_deg"].max() < 3


def same(a: Any, b: Any) -> None:
    """Arrays, and infos of arrays, of equal values and types."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key, value in a.items():
            same(value, b[key])
    elif a.dtype == object:
        for x, y in zip(a, b, strict=True):
            assert (x is None) == (y is None)
            if x is not None:
                same(x, y)
    else:
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_many_boards_do_what_each_would_do_alone(config: Config, kind: str) -> None:
    """Gymnasium's own vector env is the judge: falls, time limits, resets and infos."""
    config = dataclasses.replace(short(config, 11), randomization=RANDOM)
    keywords: dict[str, Any] = {"num_envs": 5, "config": config, "action": kind}
    ours: Any = gymnasium.make_vec(ENV, **keywords)
    theirs: Any = gymnasium.make_vec(
        ENV,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        **keywords,
    )
    assert isinstance(ours.unwrapped, BalanceVecEnv)
    assert ours.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    for name in ("single_action_space", "single_observation_space", "action_space"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert ours.observation_space == theirs.observation_space
    ends = np.zeros(2, int)
    for seed in (3, None, [9, None, 0, 2, 9]):
        got, wanted = (envs.reset(seed=seed) for envs in (ours, theirs))
        for a, b in zip(got, wanted, strict=True):
            same(a, b)
        for number in range(14):
            actions = np.asarray([STAND, LEFT_UP, 440, STAND + number % 2, 0])
            if kind == "continuous":
                actions = np.stack((actions // 21, actions % 21), axis=-1) / 10 - 1
            got, wanted = (envs.step(actions) for envs in (ours, theirs))
            for a, b in zip(got, wanted, strict=True):
                same(a, b)
            assert got[0] in ours.observation_space
            ends += got[2].sum(), got[3].sum()
    assert ends.min() > 3


def test_what_is_handed_out_stays_as_it_is(config: Config) -> None:
    envs = BalanceVecEnv(3, config=short(config, 2))
    kept = [envs.reset(seed=0)[0]]
    copies = [kept[0].copy()]
    for _ in range(4):
        obs, reward, fell, cut, info = envs.step(np.full(3, STAND))
        arrays = [obs, reward, fell, cut, *(x for x in info.values() if not isinstance(x, dict))]
        kept += arrays
        copies += [x.copy() for x in arrays]
        for a in arrays:
            assert sum(np.shares_memory(a, b) for b in kept) == 1
    for a, b in zip(kept, copies, strict=True):
        same(a, b)


def test_gymnasiums_wrappers_take_the_vector_env(config: Config) -> None:
    envs = RecordEpisodeStatistics(BalanceVecEnv(2, config=short(config, 4)))
    _, info = envs.reset(seed=0)
    for _ in range(4):
        info = envs.step(np.full(2, STAND))[4]
    assert list(info["episode"]["l"]) == [4, 4]


def test_continuous_actions_are_shares_of_the_greatest(config: Config) -> None:
    """Those of the grid do what their indices do; there are others between them."""
    told = {}
    for kind, actions in (
        ("discrete", [15 * 21, STAND, LEFT_UP]),
        ("continuous", [np.asarray([0.5, -1]), [0, 0], np.asarray([1, 0], np.float32)]),
    ):
        env = BalanceGymEnv(action=kind)
        env.reset(seed=0)
        told[kind] = np.asarray([env.step(action)[0] for action in actions])
    np.testing.assert_allclose(told["continuous"], told["discrete"], atol=1e-5)
    env.reset(seed=0)
    small = env.step([0.033, 0])[0]
    assert small[0] == pytest.approx(0.0033 * 3, abs=0.003), "0.1 mm in units of 1 cm"


@pytest.mark.parametrize(
    ("kind", "bad"),
    [
        *(("discrete", x) for x in (441, -1, 2.0, "up", None, [220], np.nan)),
        *(("continuous", x) for x in ([1.1, 0], [np.nan, 0], [1e300, 0], [0], 0.5, "up", [[0, 0]])),
    ],
)
def test_another_action_is_refused(kind: str, bad: Any) -> None:
    env = BalanceGymEnv(action=kind)
    env.reset(seed=0)
    before = env.batch.qpos
    with pytest.raises(InvalidAction) as said:
        env.step(bad)
    space = {"discrete": "Discrete(441)", "continuous": "Box(-1.0, 1.0, (2,), float32)"}
    assert str(said.value) == f"action is {bad!r}; it must be in {space[kind]}"
    np.testing.assert_array_equal(env.batch.qpos, before)


def test_the_first_of_several_bad_actions_is_named() -> None:
    envs = BalanceVecEnv(3)
    with pytest.raises(ResetNeeded):
        envs.step(np.full(3, STAND))
    envs.reset()
    for bad, said in (
        ([0, 441, -1], "action 1 is 441; it must be in MultiDiscrete([441 441 441])"),
        ([0, 1], "action is [0, 1]; it must be in MultiDiscrete"),
        ([0.0, 1, 2], "action 0 is 0.0; it must be in MultiDiscrete"),
    ):
        with pytest.raises(InvalidAction) as error:
            envs.step(bad)
        assert str(error.value).startswith(said)
    with pytest.raises(ValueError, match="2 seeds are given for 3 envs"):
        envs.reset(seed=[1, 2])


GIVEN = Config()
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"preset": "none"}, "unknown preset 'none'; known presets: paper, default"),
    ({"preset": ""}, "unknown preset ''"),
    ({"preset": {}}, "preset is {}; it must be a name"),
    ({"preset": "paper", "config": GIVEN}, "preset is 'paper', and a config is given"),
    ({"robot": "b2", "config": GIVEN}, "robot is 'b2', and a config is given; leave one out"),
    ({"robot": "rex"}, "robot is 'rex'; known robots: aliengo"),
    ({"robot": 3}, "robot is 3; it must be a name"),
    ({"action": "torque"}, "action is 'torque'; it must be one of discrete, cont"),
    ({"config": "best"}, "config is 'best'; it must be a Config"),
    ({"config": {"seed": 1}}, "config is {'seed': 1}; it must be a Config"),
    ({"config": short(GIVEN, 3, fail_tilt=95.0)}, "fail_tilt is 95"),
]


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
@pytest.mark.parametrize(("given", "said"), REFUSED)
def test_what_there_is_not_is_refused(make: Any, given: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        make(ENV, **given)
    assert str(error.value).startswith(said)


@pytest.mark.parametrize("count", [2.5, True, -1, 0])
def test_a_number_of_envs_is_whole(count: Any) -> None:
    with pytest.raises(ConfigError) as error:
        BalanceVecEnv(count)
    assert str(error.value) == f"num_envs is {count!r}; it must be a whole number above 0"


def test_another_render_mode_is_refused() -> None:
    for env in (BalanceGymEnv, BalanceVecEnv):
        with pytest.raises(UnsupportedMode, match=r"'ascii'; it must be one of .*rgb"):
            env(render_mode="ascii")
    with pytest.raises(UnsupportedMode, match="render_mode is 'human'"):
        BalanceVecEnv(2, render_mode="human")


def test_a_video_has_a_picture_per_decision(config: Config) -> None:
    assert BalanceGymEnv(config=short(config, 3, ctrl_dt=0.1)).metadata["render_fps"] == 10


def test_presets_have_their_own_observations() -> None:
    paper = BalanceGymEnv().observation_space
    assert paper.shape == (34,)
    # 1e4 m, rad/s and m/s^2 in units of 1 cm, 1 deg/s and 9.81 sin(1 deg) m/s^2
    most = [1e6, 1e4 / np.radians(1), 1e4 / (9.81 * np.sin(np.radians(1)))]
    np.testing.assert_allclose(paper.high[[0, 4, 33]], most, rtol=1e-6)
    np.testing.assert_array_equal(paper.low, -paper.high)


def test_seeds_may_come_as_an_array() -> None:
    """Board k is then the env of that seed; what is no seed is Gymnasium's to refuse."""
    envs: Any = BalanceVecEnv(4)
    seen = []
    for seed in ([7, 8, 9, 10], np.arange(7, 11), np.int64(7), list(np.arange(7, 11))):
        envs.reset(seed=seed)
        seen.append(envs.batch.state.scenario.targets.copy())
    for targets in seen[1:]:
        np.testing.assert_array_equal(targets, seen[0])
    single = BalanceGymEnv()
    single.reset(seed=9)
    np.testing.assert_array_equal(seen[0][2], single.batch.state.scenario.targets[0])
    for bad in (2.5, "3", [[1, 2, 3, 4]], {}):
        with pytest.raises(ValueError, match="it must be a whole number, or one or None for each"):
            envs.reset(seed=bad)
    for bad in ([1, 2, 3, -4], [1, 2, 3, 0.5]):
        with pytest.raises(gymnasium.error.Error, match="Seed must be"):
            envs.reset(seed=bad)


def test_options_are_refused_before_anything_starts_anew() -> None:
    mask = {"reset_mask": np.asarray([True, False])}
    env: Any
    for env in (BalanceGymEnv(), BalanceVecEnv(2)):
        env.reset(seed=0, options={})
        env.step(np.full(env.action_space.shape, STAND)[()])
        before = env.batch.qpos.copy()
        with pytest.raises(ValueError, match=r"options is {'reset_mask': .*; it must be None or"):
            env.reset(options=mask)
        np.testing.assert_array_equal(env.batch.qpos, before)


@pytest.mark.parametrize("kind", [BalanceGymEnv, BalanceVecEnv])
def test_another_robot_brings_its_size(kind: Any) -> None:
    env = kind(preset="best", robot="b2", action="continuous")
    assert env.config == for_robot(preset("best"), "b2")
    obs = env.reset(seed=0)[0].reshape(-1, 136)[0]
    for _ in range(3):
        obs = env.step(np.zeros(env.action_space.shape))[0].reshape(-1, 136)[0]
    assert np.abs(obs[:4]).max() < 0.5, "it stands at the height from which heights are counted"


@pytest.mark.slow
def test_pictures_are_of_now(env: Any) -> None:
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.unwrapped.render() is None
    envs = BalanceVecEnv(2, render_mode="rgb_array")
    single = BalanceGymEnv(render_mode="rgb_array")
    try:
        envs.reset(seed=0)
        single.reset(seed=1)
        try:
            first = envs.render()
        except RenderError as error:
            pytest.skip(str(error))
        assert first is not None
        np.testing.assert_array_equal(first[0], first[1])
        for _ in range(3):
            envs.step(np.asarray([LEFT_UP, 440]))
            single.step(440)
        later = envs.render()
        assert later is not None
        assert later[0].shape == (*render.VIDEO_SIZE[::-1], 3)
        assert later[0].dtype == np.uint8
        assert np.mean(later[0] != later[1]) > 0.01
        sky, floor = later[0][:100].mean(axis=(0, 1)), later[0][-100:].mean(axis=(0, 1))
        assert sky[2] > floor[2] + 30, "the sky is above"
        np.testing.assert_array_equal(single.render(), later[1])
        np.testing.assert_array_equal(first[0], first[1])
    finally:
        envs.close()
        single.close()


def test_a_window_plays_every_decision_at_real_speed(
    screen: list[Screen], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(render.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(render.time, "sleep", lambda s: clock.__setitem__(0, clock[0] + s))
    env = BalanceGymEnv(render_mode="human")
    env.reset(seed=0)
    assert env.render() is None
    (window,) = screen
    assert len(window.shown) == 1
    began = clock[0]
    for _ in range(5):
        clock[0] += 0.03  # what the learner takes
        env.step(STAND)
    assert len(window.shown) == 26, "25 a second"
    assert clock[0] - began == pytest.approx(1.0, abs=0.05)
    np.testing.assert_array_equal(window.shown[-1], env.batch.qpos[0])
    window.open = False  # its user has closed it
    env.step(STAND)
    assert len(window.shown) == 26
    env.close()
    env.close()


def test_no_display_gives_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = BalanceGymEnv(render_mode="human")
    with pytest.raises(
        RenderError, match=r"no window can be opened here .*; render_mode 'rgb_array' needs no di"
    ):
        env.reset()


def test_no_backend_gives_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "steam")
    env = BalanceGymEnv(render_mode="rgb_array")
    env.reset()
    with pytest.raises(RenderError, match="offscreen rendering with steam failed"):
        env.render()
    env.close()


@pytest.mark.sb3
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_stable_baselines3_finds_nothing_to_warn_of(kind: str) -> None:
    from stable_baselines3.common.env_checker import (  # pyright: ignore[reportMissingImports]
        check_env as check,
    )

    env = gymnasium.make(ENV, action=kind, render_mode="rgb_array")
    check(env, skip_render_check=False)
    env.close()


@pytest.mark.sb3
@pytest.mark.parametrize("algorithm", ["dqn", "ppo"])
def test_stable_baselines3_learns_to_balance(algorithm: str) -> None:
    """Who stands still falls in every one of these episodes."""
    example = runpy.run_path(str(EXAMPLE))
    model = example["train"](algorithm, example["DECISIONS"][algorithm], 0)
    tilt, falls = example["held_out"](model, algorithm)
    assert tilt < SCORE[algorithm]
    assert falls == 0
