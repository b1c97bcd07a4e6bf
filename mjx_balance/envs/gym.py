"""The task as Gymnasium's envs, in plain MuJoCo: one env, or many at once. No JAX.

`import mjx_balance` registers them (`registration.py`).
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded, UnsupportedMode
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjx_balance.config import Config, ConfigError, TaskConfig, check
from mjx_balance.config import preset as find_preset
from mjx_balance.envs.batch import BatchEnv, draw_episodes
from mjx_balance.files.text import quote
from mjx_balance.render.drawing import Painter, RenderError, Window
from mjx_balance.robots.catalogue import Robot
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import load_scene
from mjx_balance.task.actions import action_table, check_action
from mjx_balance.task.observation import input_rows
from mjx_balance.task.step import DIVERGED, Outcome


class _Actions:
    """The action space, and what its elements do."""

    def __init__(self, task: TaskConfig, kind: str):
        self._most = task.action_max
        self._table = action_table(task) if check_action(kind) == "discrete" else None
        self.space: spaces.Space = (
            spaces.Discrete(len(self._table))
            if self._table is not None
            else spaces.Box(-1, 1, (2,), np.float32)
        )

    def read(self, action: Any, space: spaces.Space) -> np.ndarray:
        """The action or actions as an array of a space that holds them.

        Raises:
          InvalidAction: if an action is outside the space.
        """
        # Of a space of several whole numbers, older versions of Gymnasium take any for one.
        kinds = "iu" if self._table is not None else "f"
        try:
            array = np.asarray(action)
            if self._table is None:  # a share is as good in float64
                with np.errstate(over="ignore"):
                    array = array.astype(np.float32)
        except (TypeError, ValueError):
            array = None
        if array is None or array.dtype.kind not in kinds or not space.contains(array):
            raise InvalidAction(f"{_named(action, array, self.space)}; it must be in {space}")
        return array

    def change(self, actions: np.ndarray) -> np.ndarray:
        """Height changes (n, 2), m, of actions (n,) or (n, 2)."""
        return self._most * actions if self._table is None else self._table[actions]


def _named(action: Any, array: np.ndarray | None, single: spaces.Space) -> str:
    """Names an action outside its space, or the first of several."""
    if array is not None and array.ndim == len(single.shape or ()) + 1:
        for k, own in enumerate(array):
            if not single.contains(own):
                return f"action {k} is {quote(own.tolist())}"
    return f"action is {quote(action)}"


def _config(preset: str | None, config: Config | None, robot: str | None) -> Config:
    """The config, or the preset fitted to the robot; "default" if neither is given."""
    for name, value in (("preset", preset), ("robot", robot)):
        if value is not None and not isinstance(value, str):
            raise ConfigError(f"{name} is {quote(value)}; it must be a name")
        if value is not None and config is not None:
            raise ConfigError(f"{name} is {quote(value)}, and a config is given; leave one out")
    if config is not None:
        return config
    named = find_preset("default" if preset is None else preset)
    return named if robot is None else for_robot(named, robot)


def _check_options(options: dict[str, Any] | None) -> None:
    """Refuses options, as Gymnasium's `reset_mask`: a reset starts every env anew."""
    if options:
        raise ValueError(f"options is {quote(options)}; it must be None or {{}}: there are none")


def _seeds(seed: Any, count: int) -> list[int | None]:
    """Seed of each env, or None.

    Raises:
      ValueError: if there are not as many as envs.
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + k for k in range(count)]
    seeds = np.asarray(seed, object)
    if seeds.ndim != 1:
        raise ValueError(
            f"seed is {quote(seed)}; it must be a whole number, or one or None for each env"
        )
    if len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds are given for {count} envs")
    return [int(x) if isinstance(x, np.integer) else x for x in seeds]


def _observations(task: TaskConfig, robot: Robot) -> spaces.Box:
    """All that `task.step` lets through; larger values are a diverged simulation's."""
    scale = np.asarray([row.scale for row in input_rows(task, robot)], np.float32)
    most = DIVERGED / scale
    return spaces.Box(-most, most, dtype=np.float32)


def _check_mode(mode: str | None, known: Sequence[str]) -> None:
    if mode is not None and mode not in known:
        raise UnsupportedMode(
            f"render_mode is {quote(mode)}; it must be one of {', '.join(known)}, or None"
        )


class BalanceGymEnv(gymnasium.Env[np.ndarray, Any]):
    """A quadruped on a board that tilts in two axes: `BalanceEnv` in plain MuJoCo.

    A step is a decision of `ctrl_dt`. A fall terminates an episode, the time limit truncates it.
    `info` holds `tilt_deg`, the body's tilt, its mean over the decision, and `fall`.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        preset: str | None = None,
        config: Config | None = None,
        action: str = "discrete",
        render_mode: str | None = None,
        robot: str | None = None,
    ):
        """Builds the scene.

        Args:
          preset: name of the config; "default" if neither is given.
          config: instead of preset and robot; its task, robot and randomisation are what counts.
          action: "discrete", the paper's grid, or "continuous", a_x and a_y as shares of
            `action_max`, -1 to 1.
          render_mode: "human", a window in which every decision takes its time; "rgb_array"; or
            none.
          robot: as `Config.robot`, for which the preset is made; our own if none.

        Raises:
          ConfigError: for an unknown preset, robot or kind of action, or a config that cannot be
            run.
          UnsupportedMode: for another render mode.
        """
        _check_mode(render_mode, self.metadata["render_modes"])
        self.config = check(_config(preset, config, robot))
        self.scene = load_scene(self.config)
        self.batch: BatchEnv | None = None
        task = self.config.task
        self._actions = _Actions(task, action)
        self.action_space = self._actions.space
        self.observation_space = _observations(task, self.scene.robot)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": 1 / task.ctrl_dt}
        self._running = False
        self._window: Window | None = None
        self._painter: Painter | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts a fresh scenario from the settled stance.

        Args:
          seed: of the scenarios from here on; none: the generator goes on.
          options: there are none.

        Raises:
          ValueError: if there are options.
        """
        _check_options(options)
        super().reset(seed=seed)
        episodes = draw_episodes(self.config, self.scene.robot, [self.np_random])
        if self.batch is None:
            self.batch = BatchEnv(self.scene, episodes, threads=1)
        else:
            self.batch.reset(np.arange(1), episodes)
        self._running = True
        self._show(self.batch.qpos[:, None])
        return self.batch.initial_obs[0].astype(np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one decision.

        Raises:
          InvalidAction: for what is not in the action space.
          ResetNeeded: before the first reset, and after the end of an episode.
        """
        if not self._running or self.batch is None:
            raise ResetNeeded("no episode is under way; call reset() before step()")
        read = self._actions.read(action, self.action_space)
        outcome = self.batch.step(self._actions.change(read[None]))
        self._show(self.batch.path)
        terminated = bool(outcome.terminated[0])
        truncated = bool(_truncated(self.batch, outcome)[0])
        self._running = not (terminated or truncated)
        info = {"tilt_deg": float(outcome.tilt[0].mean()), "fall": terminated}
        obs = outcome.obs[0].astype(np.float32)
        return obs, float(outcome.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The picture (height, width, 3) of `rgb_array`; a window needs no call."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() gives no picture without a render_mode; choose one")
        if self.render_mode != "rgb_array":
            return None
        self._painter = self._painter or Painter(self.config)
        qpos = self.scene.stance.qpos if self.batch is None else self.batch.qpos[0]
        return self._painter.draw(qpos)

    def close(self) -> None:
        """Closes the window and ends the process that draws."""
        for renderer in (self._window, self._painter):
            if renderer is not None:
                renderer.close()
        self._window = self._painter = None

    def _show(self, qpos: np.ndarray) -> None:
        """Plays states (1, steps, nq) in the window, if there is to be one."""
        if self.render_mode != "human":
            return
        if self._window is None:
            try:
                self._window = Window(self.config)
            except RenderError as error:
                raise RenderError(f"{error}; render_mode 'rgb_array' needs no display") from error
        self._window.play(qpos[0])


class BalanceVecEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many envs in `mujoco.batch.Batch`, on all cores; env k does what one alone would do.

    An env that terminates or is truncated is reset in the same step: its observation is the first
    of the new episode, `final_obs` and `final_info` are of the old one.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    # Of the class: an env whose constructor failed is closed, too.
    _painter: Painter | None = None

    def __init__(
        self,
        num_envs: int = 1,
        preset: str | None = None,
        config: Config | None = None,
        action: str = "discrete",
        render_mode: str | None = None,
        robot: str | None = None,
    ):
        """Builds the scene.

        Args:
          num_envs: how many.
          preset: name of the config.
          config: instead of preset and robot.
          action: "discrete" or "continuous".
          render_mode: "rgb_array", one picture for each board, or none.
          robot: for which the preset is made.

        Raises:
          ConfigError: as `BalanceGymEnv`.
          UnsupportedMode: as `BalanceGymEnv`.
        """
        _check_mode(render_mode, self.metadata["render_modes"])
        whole = isinstance(num_envs, int | np.integer) and not isinstance(num_envs, bool)
        if not whole or num_envs < 1:
            raise ConfigError(f"num_envs is {quote(num_envs)}; it must be a whole number above 0")
        self.config = check(_config(preset, config, robot))
        self.scene = load_scene(self.config)
        self.batch: BatchEnv | None = None
        task = self.config.task
        self._actions = _Actions(task, action)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_action_space = self._actions.space
        self.single_observation_space = _observations(task, self.scene.robot)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.metadata = self.metadata | {"render_fps": 1 / task.ctrl_dt}
        self._rngs: list[np.random.Generator] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts fresh scenarios in all envs.

        Args:
          seed: env k gets `seed + k`, or `seed[k]`; one that gets none goes on with its
            generator.
          options: there are none; `reset_mask` is for envs that do not reset by themselves.

        Raises:
          ValueError: if there are options, or not as many seeds as envs.
        """
        _check_options(options)
        seeds = _seeds(seed, self.num_envs)
        old = self._rngs or [None] * self.num_envs
        self._rngs = [
            np_random(number)[0] if rng is None or number is not None else rng
            for number, rng in zip(seeds, old, strict=True)
        ]
        episodes = draw_episodes(self.config, self.scene.robot, self._rngs)
        if self.batch is None:
            self.batch = BatchEnv(self.scene, episodes)
        else:
            self.batch.reset(np.arange(self.num_envs), episodes)
        return self.batch.initial_obs.astype(np.float32), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one decision in every env.

        Raises:
          InvalidAction: for what is not in the action space.
          ResetNeeded: before the first reset.
        """
        if self.batch is None:
            raise ResetNeeded("no episode is under way; call reset() before step()")
        read = self._actions.read(actions, self.action_space)
        outcome = self.batch.step(self._actions.change(read))
        terminated, truncated = outcome.terminated, _truncated(self.batch, outcome)
        done = terminated | truncated
        obs, info = outcome.obs.astype(np.float32), _info(outcome, ~done)
        if done.any():
            ids = np.flatnonzero(done)
            final = np.full(self.num_envs, None, object)
            for k in ids:
                final[k] = obs[k].copy()
            info |= {"final_obs": final, "_final_obs": done}
            info |= {"final_info": _info(outcome, done), "_final_info": done.copy()}
            rngs = [self._rngs[k] for k in ids]
            self.batch.reset(ids, draw_episodes(self.config, self.scene.robot, rngs))
            obs[ids] = self.batch.initial_obs[ids]
        return obs, outcome.reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3) of each env."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() gives no picture without a render_mode; choose one")
            return None
        self._painter = self._painter or Painter(self.config)
        stance = np.tile(self.scene.stance.qpos, (self.num_envs, 1))
        states = stance if self.batch is None else self.batch.qpos
        return tuple(self._painter.draw(state) for state in states)

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the process that draws."""
        if self._painter is not None:
            self._painter.close()

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore
        """Of each env; none before the first reset."""
        return tuple(self._rngs)


def _truncated(batch: BatchEnv, outcome: Outcome) -> np.ndarray:
    """(n,) whether the time limit of a standing robot is reached."""
    return ~outcome.terminated & (batch.state.env_steps >= batch.task.episode_length)


def _info(outcome: Outcome, where: np.ndarray) -> dict[str, np.ndarray]:
    """Tilt and fall of some envs, in Gymnasium's form: 0 elsewhere, and which they are."""
    tilt, fall = np.where(where, outcome.tilt.mean(axis=-1), 0.0), outcome.terminated & where
    return {"tilt_deg": tilt, "_tilt_deg": where.copy(), "fall": fall, "_fall": where.copy()}
