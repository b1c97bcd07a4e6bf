"""`BalanceEnv`: one robot on one board, a brax environment with 441 or with continuous actions."""

from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from mjx_balance.config import ACTION_AXES, Config, check, preset
from mjx_balance.sim.engines.table import make_engine
from mjx_balance.sim.scene import load_scene
from mjx_balance.task import events
from mjx_balance.task.actions import action_table, check_action
from mjx_balance.task.observation import input_rows
from mjx_balance.task.pushes import Pushes, draw_velocity, push_decisions
from mjx_balance.task.randomization import draw_params, param_draws
from mjx_balance.task.reward import reward_rows
from mjx_balance.task.sensors import count_draws, draw_decision, draw_errors, joint_readings
from mjx_balance.task.step import EnvState, initial_memory, observation, step
from mjx_balance.task.symmetry import Symmetries, symmetries
from mjx_balance.task.tilt import MOST_CALLS, draw_scenario


class Metric(NamedTuple):
    """A row of an env's table `metrics`: how the mean of a metric is logged."""

    name: str | None = None  #: logged name; None: its own
    per: Literal["decision", "minute", "call"] = "decision"
    """A mean over decisions, a rate per minute of one env, or a sum over a call's decisions."""
    per_seed: bool = False  #: whether it is also logged for every seed, if there are several


class BalanceEnv(Env):
    """A quadruped on a board that tilts in two axes (paper section 3).

    One step is one decision: `sim_steps` physics steps of the config's engine. `pipeline_state` is
    the `EnvState` of `task.step`. `done` is 1 after a fall or at the time limit;
    `info["truncation"]` is 1 only at the time limit, so that `done * (1 - truncation)` marks true
    terminations. A done env is not reset by `step`: the observation it returns is the one before
    the reset.

    This is one env; `jax.vmap` it over thousands. For brax's own trainers:
    `envs.brax.wrap`.
    """

    metrics: ClassVar[Mapping[str, Metric]] = {
        "tilt_deg": Metric(per_seed=True),
        "fall": Metric("falls_per_minute", per="minute", per_seed=True),
    }
    """Metrics of `State.metrics` that are logged otherwise than as a mean under their own name."""

    def __init__(self, config: Config | None = None, action: str | None = None):
        """Builds the scene.

        Args:
          config: the preset "default" if none; `robots.limits.for_robot` makes
            another robot's.
          action: "discrete", the paper's grid, or "continuous", a_x and a_y as shares of
            `action_max`, -1 to 1; None: as `config.task.action`, discrete without a config.

        Raises:
          ConfigError: if the config is invalid, or for another kind of action.
        """
        self.config = check(config or preset("default"))
        self._discrete = check_action(action, config and config.task) == "discrete"
        self.scene = load_scene(self.config)
        self.engine = make_engine(self.config, self.scene)
        self._table = action_table(self.config.task)

    @property
    def observation_size(self) -> int:
        return len(input_rows(self.config.task, self.scene.robot))

    @property
    def action_size(self) -> int:
        """Number of discrete actions, or of numbers in a continuous action."""
        return self.config.task.num_actions if self._discrete else ACTION_AXES

    @property
    def action_factors(self) -> tuple[int, ...]:
        """Levels of roll and of pitch; a discrete action is a mixed-radix number of them."""
        return (self.config.task.action_levels,) * ACTION_AXES

    @property
    def symmetries(self) -> Symmetries:
        """Reflections of observations and actions."""
        return symmetries(self.config.task, self.scene.robot, self.continuous)

    @property
    def continuous(self) -> bool:
        """Whether an action is two numbers."""
        return not self._discrete

    @property
    def backend(self) -> str:
        """The physics engine."""
        return self.config.engine

    def reset(self, rng: jax.Array) -> State:
        """Starts a new tilt scenario from the settled stance, drawn from a PRNG key."""
        task, robot, scene = self.config.task, self.scene.robot, self.scene
        ranges, params, pushes = self.config.randomization, None, None
        errors = None
        # No key depends on how many are split off: pushes change no other draw.
        rng, key_params, key_noise, key_pushes, key_errors, key_event = jax.random.split(rng, 6)
        info = {
            "episode_length": jnp.int32(task.episode_length),
            "truncation": jnp.float32(0.0),
        }
        if ranges.varies:
            draws = jax.random.uniform(key_params, (param_draws(ranges),), jnp.float32)
            params = draw_params(ranges, robot, draws)
            info["noise_key"] = key_noise
        if ranges.sensors_err:
            draws = jax.random.uniform(key_errors, (count_draws(robot),), jnp.float32)
            errors = draw_errors(ranges, robot, draws)
        event = events.sample_event(
            *(ranges, robot, params, task.episode_length),
            lambda count: jax.random.uniform(key_event, (count,), jnp.float32),
        )
        due = push_decisions(task, ranges, task.episode_length * task.ctrl_dt)
        if len(due):
            draws = jax.random.uniform(key_pushes, (len(due), 2), jnp.float32)
            pushes = Pushes(draw_velocity(ranges, draws), jnp.asarray(due, jnp.int32))
        keys = iter(jax.random.split(rng, MOST_CALLS))

        def uniform(shape: tuple[int, ...], low: float, high: float) -> jax.Array:
            return jax.random.uniform(next(keys), shape, jnp.float32, low, high)

        scenario = draw_scenario(task, uniform)
        qpos, still, tilt = (jnp.asarray(x, jnp.float32) for x in scene.start(scenario.start))
        start = EnvState(
            physics=self.engine.initial(qpos),
            memory=initial_memory(task, robot, still, tilt, errors),
            scenario=scenario,
            env_steps=jnp.int32(0),
            params=params,
            pushes=pushes,
            errors=errors,
            event=event,
        )
        angles = start.physics.qpos[scene.leg_qpos]
        if errors is not None:
            angles = joint_readings(errors, angles)
        obs = observation(task, robot, start.memory, angles)
        zero = jnp.float32(0.0)
        rewards = [f"reward_{row.name}" for row in reward_rows(task)]
        metrics = dict.fromkeys(("tilt_deg", "fall", "diverged", *rewards), zero)
        return State(start, obs, zero, zero, metrics, info)  # pyright: ignore[reportArgumentType]

    def reset_staggered(self, rng: jax.Array) -> State:
        """`reset` with a random time limit, so that first episodes do not time out together."""
        key_reset, key_length = jax.random.split(rng)
        state = self.reset(key_reset)
        most = self.config.task.episode_length
        length = jax.random.randint(key_length, (), 1, most + 1, jnp.int32)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            info=state.info | {"episode_length": length}
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one decision, and returns the state `ctrl_dt` later.

        `action` is an index, 0 to action_size - 1, or two shares, clipped to -1 to 1.
        """
        task, info, draws = self.config.task, state.info, None
        before: EnvState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        if "noise_key" in info:
            key, *own = jax.random.split(info["noise_key"], 2 if before.errors is None else 4)
            keys = iter(own)
            draws = draw_decision(
                task,
                before.errors,
                lambda shape: jax.random.normal(next(keys), shape, jnp.float32),
                lambda shape: jax.random.uniform(next(keys), shape, jnp.float32),
            )
            info = info | {"noise_key": key}
        if self._discrete:
            change = jnp.asarray(self._table, jnp.float32)[action]
        else:
            change = task.action_max * jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        after, outcome = step(task, self.scene.robot, self.engine, before, change, draws)
        truncated = ~outcome.terminated & (after.env_steps >= info["episode_length"])
        metrics = {
            "tilt_deg": outcome.tilt.mean(),
            "fall": outcome.terminated.astype(jnp.float32),
            "diverged": outcome.diverged.astype(jnp.float32),
            **{f"reward_{name}": term for name, term in outcome.rewards.items()},
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=after,
            obs=outcome.obs,
            reward=outcome.reward,
            done=(outcome.terminated | truncated).astype(jnp.float32),
            metrics=state.metrics | metrics,
            info=info | {"truncation": truncated.astype(jnp.float32)},
        )
