"""Gymnasium's envs in plain MuJoCo, one or many at once; `import mjx_balance` registers them."""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import InvalidAction, ResetNeeded, UnsupportedMode
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjx_balance.config import Config, ConfigError, check
from mjx_balance.config import preset as find_preset
from mjx_balance.envs.batch import BatchEnv, draw_episodes
from mjx_balance.errors import quote
from mjx_balance.render.drawing import Painter, RenderError, Window
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import load_scene
from mjx_balance.task.actions import action_table, check_action
from mjx_balance.task.observation import input_rows
from mjx_balance.task.step import DIVERGED

NO_EPISODE = "no episode is under way; call reset() before step()"


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


class _Balance:
    """What one env and many have in common: scene, actions, episodes and pictures."""

    metadata: dict[str, Any]
    threads: int | None = None  #: worker threads; None: all cores
    # Of the class: an env whose constructor failed is closed, too.
    _painter: Painter | None = None
    _window: Window | None = None
    _spec: EnvSpec | None = None

    def __init__(
        self,
        preset: str | None = None,
        config: Config | None = None,
        action: str | None = None,
        render_mode: str | None = None,
        robot: str | None = None,
    ):
        """Builds the scene.

        Args:
          preset: name of the config; "default" if neither is given.
          config: instead of preset and robot; its task, robot and randomisation count.
          action: "discrete", the paper's grid, or "continuous", a_x and a_y as shares of
            `action_max`, -1 to 1; None: as the given config's `task.action`, discrete without.
          render_mode: "human", a window in which every decision takes its time (one env only);
            "rgb_array"; or None.
          robot: as `Config.robot`, for which the preset is adapted; our own if None.

        Raises:
          ConfigError: for an unknown preset, robot or kind of action, or a config that cannot be
            run.
          UnsupportedMode: for another render mode.
        """
        known = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in known:
            raise UnsupportedMode(
                f"render_mode is {quote(render_mode)}; it must be one of {', '.join(known)}, or "
                "None"
            )
        self.config = check(_config(preset, config, robot))
        self.scene = load_scene(self.config)
        self.batch: BatchEnv | None = None
        self.render_mode = render_mode
        task = self.config.task
        self.max_episode_steps = task.episode_length
        self.metadata = self.metadata | {"render_fps": 1 / task.ctrl_dt}
        discrete = check_action(action, config and config.task) == "discrete"
        self._table = action_table(task) if discrete else None
        shares = spaces.Box(-1, 1, (2,), np.float32)
        single = shares if self._table is None else spaces.Discrete(len(self._table))
        self.action_space = self.single_action_space = single
        # All that `task.step` lets through; larger values are a diverged simulation's.
        rows = input_rows(task, self.scene.robot)
        most = [DIVERGED * (1 + (row.time_constant or 0)) / row.scale for row in rows]
        most = np.asarray(most, np.float32)
        self.observation_space = self.single_observation_space = spaces.Box(-most, most)

    def __getstate__(self) -> dict[str, Any]:
        """Copies and other processes draw for themselves."""
        return vars(self) | {"_painter": None, "_window": None}

    @property
    def spec(self) -> EnvSpec | None:  # pyright: ignore
        """What Gymnasium has made the env of, with the time limit of its config."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = copy.copy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self.max_episode_steps

    def _start(self, rngs: Sequence[np.random.Generator], ids: np.ndarray) -> np.ndarray:
        """Starts an episode from each generator in envs `ids`; returns their first observations."""
        config = self.config
        episodes = draw_episodes(config.task, config.randomization, self.scene.robot, rngs)
        if self.batch is None:
            self.batch = BatchEnv(self.scene, episodes, self.threads)
        else:
            self.batch.reset(ids, episodes)
        return self.batch.initial_obs[ids].astype(np.float32)

    def _height_changes(self, action: Any, space: spaces.Space) -> np.ndarray:
        """Height changes (..., 2), m, of an action, or of one per env, that must be in `space`."""
        # Of a space of several whole numbers, older versions of Gymnasium take any for one.
        kinds = "f" if self._table is None else "iu"
        try:
            array = np.asarray(action)
            if self._table is None:  # a share is as good in float64
                with np.errstate(over="ignore"):
                    array = array.astype(np.float32)
        except (TypeError, ValueError):
            array = None
        if array is None or array.dtype.kind not in kinds or not space.contains(array):
            raise InvalidAction(f"{self._invalid(action, array)}; it must be in {space}")
        if self._table is None:
            return self.config.task.action_max * array
        return self._table[array.astype(int)]

    def _invalid(self, action: Any, array: np.ndarray | None) -> str:
        """Names an action outside its space, or the first of several."""
        if array is not None and array.ndim == len(self.single_action_space.shape or ()) + 1:
            for k, own in enumerate(array):
                if not self.single_action_space.contains(own):
                    return f"action {k} is {quote(own.tolist())}"
        return f"action is {quote(action)}"

    def _draw(self, count: int) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3) of each env, or None without render mode `rgb_array`."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() gives no picture without a render_mode; choose one")
        if self.render_mode != "rgb_array":
            return None
        self._painter = self._painter or Painter(self.scene)
        stance = [self.scene.stance.qpos] * count
        states = stance if self.batch is None else self.batch.qpos
        return tuple(self._painter.draw(state) for state in states)


class BalanceGymEnv(_Balance, gymnasium.Env[np.ndarray, Any]):  # pyright: ignore
    """A quadruped on a board that tilts in two axes: `BalanceEnv` in plain MuJoCo.

    A step is a decision of `ctrl_dt`. A fall terminates an episode, the time limit truncates it.
    `info` holds `tilt_deg`, the body's tilt, its mean over the decision, and `fall`.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012
    threads = 1
    _running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts a new scenario from the settled stance; without a seed, the generator continues.

        Raises:
          ValueError: if there are options; none exist.
        """
        if options:
            raise ValueError(f"options is {quote(options)}; it must be None or {{}}")
        super().reset(seed=seed)
        obs = self._start([self.np_random], np.arange(1))
        self._running = True
        assert self.batch is not None
        self._show(self.batch.qpos[:, None])
        return obs[0], {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one decision.

        Raises:
          InvalidAction: for an action outside the action space.
          ResetNeeded: before the first reset, and after the end of an episode.
        """
        if not self._running or self.batch is None:
            raise ResetNeeded(NO_EPISODE)
        outcome = self.batch.step(self._height_changes(action, self.action_space)[None])
        self._show(self.batch.path)
        terminated = bool(outcome.terminated[0])
        over = self.batch.state.env_steps[0] >= self.max_episode_steps
        truncated = bool(over and not terminated)
        self._running = not (terminated or truncated)
        info = {"tilt_deg": float(outcome.tilt[0].mean()), "fall": terminated}
        obs = outcome.obs[0].astype(np.float32)
        return obs, float(outcome.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The picture (height, width, 3) of `rgb_array`; a window needs no call."""
        pictures = self._draw(1)
        return None if pictures is None else pictures[0]

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
                self._window = Window(self.scene)
            except RenderError as error:
                raise RenderError(f"{error}; render_mode 'rgb_array' needs no display") from error
        self._window.play(qpos[0])


class BalanceVecEnv(_Balance, VectorEnv[np.ndarray, np.ndarray, np.ndarray]):  # pyright: ignore
    """Many envs in `mujoco.batch.Batch`, on all cores; env k equals a single env with its seed.

    An env that terminates or is truncated is reset as Gymnasium's `autoreset_mode` says. In mode
    SAME_STEP its observation is the first of the new episode; `final_obs` and `final_info` are of
    the old one.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        preset: str | None = None,
        config: Config | None = None,
        action: str | None = None,
        render_mode: str | None = None,
        robot: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
    ):
        """Builds the scene of `num_envs` envs; the other arguments are those of `BalanceGymEnv`.

        Args:
          num_envs: number of envs.
          preset: as for one env, like config, action, render_mode and robot.
          config: see preset.
          action: see preset.
          render_mode: "rgb_array" or None.
          robot: see preset.
          autoreset_mode: SAME_STEP; NEXT_STEP, which some of Gymnasium's vector wrappers need; or
            DISABLED, with `reset(options={"reset_mask": ...})`.
          max_episode_steps: time limit, decisions; the config's if None.
        """
        whole = isinstance(num_envs, int | np.integer) and not isinstance(num_envs, bool)
        if not whole or num_envs < 1:
            raise ConfigError(f"num_envs is {quote(num_envs)}; it must be a whole number above 0")
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            known = ", ".join(repr(x.value) for x in AutoresetMode)
            raise ConfigError(
                f"autoreset_mode is {quote(autoreset_mode)}; it must be one of {known}"
            ) from error
        super().__init__(preset, config, action, render_mode, robot)
        longest = self.max_episode_steps
        if max_episode_steps is not None and not 0 < max_episode_steps <= longest:
            raise ConfigError(
                f"max_episode_steps is {quote(max_episode_steps)}; it must be from 1 to {longest}, "
                "the config's episode_length"
            )
        self.max_episode_steps = max_episode_steps or longest
        self.metadata["autoreset_mode"] = self._mode = mode
        self.num_envs = num_envs
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._rngs: list[np.random.Generator] = []
        self._over = np.zeros(num_envs, bool)  # episodes that have ended, and nothing began since
        self._obs = np.zeros(self.observation_space.shape or (), np.float32)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts fresh scenarios in all envs, or in those of a mask.

        Env k gets seed `seed + k`, or `seed[k]`; without a seed, its generator continues.

        Args:
          seed: of the scenarios.
          options: in mode DISABLED, `reset_mask` (num_envs,), bool: which envs; None: all.

        Raises:
          ValueError: for other options, or not as many seeds as envs.
          ResetNeeded: for a mask before the first reset.
        """
        mask = self._reset_mask(options)
        if self.batch is None and not mask.all():
            raise ResetNeeded("reset_mask is given before the first reset of all envs")
        seeds = _seeds(seed, self.num_envs)
        old = self._rngs or [None] * self.num_envs
        self._rngs = [
            np_random(number)[0] if rng is None or (number is not None and starts) else rng
            for number, rng, starts in zip(seeds, old, mask, strict=True)
        ]
        self._restart(mask)
        return self._obs.copy(), {}

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        """(n,) which envs a reset starts anew."""
        if not options:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(options.get("reset_mask"))
        fits = mask.dtype == bool and mask.shape == (self.num_envs,) and mask.any()
        if self._mode is not AutoresetMode.DISABLED or not fits or len(options) > 1:
            raise ValueError(
                f"options is {quote(options)}; it must be None or {{}}, or with autoreset_mode "
                f"'Disabled' {{'reset_mask': bool array ({self.num_envs},), any of it true}}"
            )
        return mask

    def _restart(self, mask: np.ndarray) -> None:
        """Starts an episode in the envs of a mask (n,), bool."""
        ids = np.flatnonzero(mask)
        self._obs[ids] = self._start([self._rngs[k] for k in ids], ids)
        self._over[ids] = False

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one decision in every env; in mode NEXT_STEP, an env that is done is reset instead.

        Raises:
          InvalidAction: for an action outside the action space.
          ResetNeeded: before the first reset, and in mode DISABLED after the end of an episode.
        """
        change = self._height_changes(actions, self.action_space)
        if self.batch is None or (self._mode is AutoresetMode.DISABLED and self._over.any()):
            raise ResetNeeded(NO_EPISODE)
        moves = ~self._over  # where not, an episode starts
        ids = np.flatnonzero(moves)
        reward, tilt = np.zeros(self.num_envs), np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        if len(ids):
            outcome = self.batch.step(change[ids], None if moves.all() else ids)
            self._obs[ids], reward[ids] = outcome.obs, outcome.reward
            tilt[ids], terminated[ids] = outcome.tilt.mean(axis=-1), outcome.terminated
            late = self.batch.state.env_steps[ids] >= self.max_episode_steps
            truncated[ids] = ~outcome.terminated & late
        if not moves.all():
            self._restart(~moves)
        done = terminated | truncated
        self._over = done.copy()
        same_step = self._mode is AutoresetMode.SAME_STEP
        info = _info(tilt, terminated, ~done if same_step else moves)
        if same_step and done.any():
            final = np.full(self.num_envs, None, object)
            for k in np.flatnonzero(done):
                final[k] = self._obs[k].copy()
            info |= {"final_obs": final, "_final_obs": done}
            info |= {"final_info": _info(tilt, terminated, done), "_final_info": done.copy()}
            self._restart(done)
        return self._obs.copy(), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3) of each env."""
        return self._draw(self.num_envs)

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the process that draws."""
        if self._painter is not None:
            self._painter.close()

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore
        """Of each env; none before the first reset."""
        return tuple(self._rngs)


def _seeds(seed: Any, count: int) -> list[int | None]:
    """Seed of each env, or None."""
    if isinstance(seed, int | np.integer):
        return [int(seed) + k for k in range(count)]
    seeds = np.asarray([None] * count if seed is None else seed, object)
    if seeds.ndim != 1:
        raise ValueError(
            f"seed is {quote(seed)}; it must be a whole number, or one or None for each env"
        )
    if len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds are given for {count} envs")
    return [int(x) if isinstance(x, np.integer) else x for x in seeds]


def _info(tilt: np.ndarray, fall: np.ndarray, where: np.ndarray) -> dict[str, np.ndarray]:
    """Tilt and fall of some envs, in Gymnasium's form: 0 elsewhere, and which they are."""
    values = {"tilt_deg": np.where(where, tilt, 0.0), "fall": fall & where}
    return values | {"_tilt_deg": where.copy(), "_fall": where.copy()}
