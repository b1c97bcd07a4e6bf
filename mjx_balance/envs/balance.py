"""`BalanceEnv`: one robot on one board, a brax environment with 441 or with continuous actions."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from mjx_balance.config import ACTION_AXES, Config, check, preset
from mjx_balance.envs.metrics import Metric
from mjx_balance.sim.engines.choice import make_engine
from mjx_balance.sim.engines.engine import Engine, settled
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task import decision, tilt
from mjx_balance.task.actions import action_table, check_action
from mjx_balance.task.observation import input_rows
from mjx_balance.task.pushes import Pushes, draw_kicks, kick, kicked_decisions
from mjx_balance.task.randomization import DRAWS, draw_conditions
from mjx_balance.task.reward import reward_rows
from mjx_balance.task.symmetry import Symmetries, symmetries


class BalanceEnv(Env):
    """A quadruped on a board that tilts in two axes (paper section 3).

    One step is one decision: `sim_steps` physics steps of the config's engine. `done` is 1 after a
    fall or at the time limit; `info["truncation"]` is 1 only at the time limit, so
    that `done * (1 - truncation)` marks true terminations. A done env is not reset
    by `step`: the observation it returns is the one before the reset.

    Written for one board; `jax.vmap` it over thousands. For brax's own trainers:
    `brax_training.wrap`.
    """

    metrics: ClassVar[Mapping[str, Metric]] = {
        "tilt_deg": Metric(per_seed=True),
        "fall": Metric("falls_per_minute", per="minute", per_seed=True),
    }
    """Metrics of `State.metrics` that are logged otherwise than as a mean under their own name."""

    def __init__(self, config: Config | None = None, action: str = "discrete"):
        """Builds the scene.

        Args:
          config: the preset "default" if none; `robots.limits.for_robot` makes
            another robot's.
          action: "discrete", the paper's grid, or "continuous", a_x and a_y as shares of
            `action_max`, -1 to 1.

        Raises:
          ConfigError: if the config cannot be run, or for another kind of action.
        """
        self._discrete = check_action(action) == "discrete"
        self.config = check(config or preset("default"))
        self.scene: Scene = load_scene(self.config)
        self._engine: Engine = make_engine(self.scene)
        self._table = action_table(self.config.task)
        ranges, task = self.config.randomization, self.config.task
        self._randomised = ranges.varies
        self._kicked = kicked_decisions(task, ranges, task.episode_length * task.ctrl_dt)

    @property
    def observation_size(self) -> int:
        return len(input_rows(self.config.task, self.scene.robot))

    @property
    def action_size(self) -> int:
        """Number of discrete actions, or of the numbers that make a continuous one."""
        return self.config.task.num_actions if self._discrete else ACTION_AXES

    @property
    def action_factors(self) -> tuple[int, ...]:
        """A discrete action as a mixed-radix number: levels of roll, levels of pitch."""
        return (self.config.task.action_levels,) * ACTION_AXES

    @property
    def symmetries(self) -> Symmetries:
        """How observations and discrete actions look in a mirror."""
        return symmetries(self.config.task, self.scene.robot)

    @property
    def backend(self) -> str:
        """The physics engine."""
        return self.config.engine

    def reset(self, rng: jax.Array) -> State:
        """Starts a fresh tilt scenario from the settled stance.

        Args:
          rng: PRNG key.

        Returns:
          State with obs (obs_size,).
        """
        task, robot = self.config.task, self.scene.robot
        # No key depends on how many are split off: pushes change no other draw.
        rng, key_conditions, key_noise, key_kicks = jax.random.split(rng, 4)
        physics = settled(self.scene)
        memory = decision.start(task, robot, jnp.asarray(self.scene.stance.imu, jnp.float32))
        info = {
            "scenario": self._scenario(rng),
            "memory": memory,
            "decision": jnp.int32(0),
            "decisions_left": jnp.int32(task.episode_length),
            "truncation": jnp.float32(0.0),
        }
        if self._randomised:
            uniform = jax.random.uniform(key_conditions, (DRAWS,))
            info |= {
                "conditions": draw_conditions(self.config.randomization, robot, uniform),
                "noise_key": key_noise,
            }
        if len(self._kicked):
            uniform = jax.random.uniform(key_kicks, (len(self._kicked), 2))
            info["kicks"] = draw_kicks(self.config.randomization, uniform)
        obs = decision.observation(task, robot, memory, physics.qpos[self.scene.leg_qpos])
        zero = jnp.float32(0.0)
        rewards = [f"reward_{row.name}" for row in reward_rows(task)]
        metrics = dict.fromkeys(("tilt_deg", "fall", "diverged", *rewards), zero)
        return State(physics, obs, zero, zero, metrics, info)  # pyright: ignore[reportArgumentType]

    def reset_staggered(self, rng: jax.Array) -> State:
        """`reset`, but with a random part of the episode's time limit already used.

        For the first episodes of a batch, which would otherwise all time out together.
        """
        key_reset, key_left = jax.random.split(rng)
        state = self.reset(key_reset)
        left = jax.random.randint(key_left, (), 1, self.config.task.episode_length + 1)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            info=state.info | {"decisions_left": left}
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one decision.

        Args:
          state: from `reset` or `step`.
          action: () action index, 0 to action_size - 1; or (2,), clipped to -1 to 1.

        Returns:
          The state `ctrl_dt` later.
        """
        task, robot = self.config.task, self.scene.robot
        info: dict[str, Any] = state.info
        change = self._change(action)
        conditions = info.get("conditions")
        late = None if conditions is None else conditions.latency > 0
        memory, targets = decision.controls(
            task, robot, info["memory"], change, late, info["scenario"], info["decision"]
        )
        before: Any = state.pipeline_state
        if "kicks" in info:
            added = kick(Pushes(info["kicks"], self._kicked), info["decision"])
            before = before._replace(qvel=before.qvel.at[self.scene.trunk_velocity].add(added))
        with jax.named_scope("physics"):
            moved, motion = self._engine(before, self.scene.ctrl(targets), conditions)
        samples = motion.imu
        if conditions is not None:
            key, key_noise = jax.random.split(info["noise_key"])
            noise = jax.random.normal(key_noise, samples.shape)
            samples = samples + conditions.imu_noise * noise
            info = info | {"noise_key": key}
        angles = moved.qpos[self.scene.leg_qpos]
        memory, outcome = decision.outcome(task, robot, memory, samples, motion.tilt, angles)
        truncated = ~outcome.fell & (info["decisions_left"] <= 1)
        metrics = {
            "tilt_deg": outcome.tilt.mean(),
            "fall": outcome.fell.astype(jnp.float32),
            "diverged": outcome.diverged.astype(jnp.float32),
            **{f"reward_{name}": term for name, term in outcome.rewards.items()},
        }
        info = info | {
            "memory": memory,
            "decision": info["decision"] + 1,
            "decisions_left": info["decisions_left"] - 1,
            "truncation": truncated.astype(jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=moved,
            obs=outcome.obs,
            reward=sum(outcome.rewards.values()),
            done=(outcome.fell | truncated).astype(jnp.float32),
            metrics=state.metrics | metrics,
            info=info,
        )

    def _change(self, action: jax.Array) -> jax.Array:
        """Height changes (2,) of an action, m."""
        if self._discrete:
            return jnp.asarray(self._table)[action]
        return self.config.task.action_max * jnp.clip(action, -1.0, 1.0)

    def _scenario(self, key: jax.Array) -> tilt.Scenario:
        """Draws the targets, and the age of the first."""
        task = self.config.task
        count = tilt.num_targets(task, task.episode_length * task.ctrl_dt)
        key_disc, key_square, key_which, key_phase = jax.random.split(key, 4)
        return tilt.draw_scenario(
            task,
            disc=jax.random.uniform(key_disc, (2, count)),
            square=jax.random.uniform(key_square, (count, 2), minval=-1.0),
            which=jax.random.uniform(key_which, (count, 1)),
            phase=jax.random.uniform(key_phase),
        )
