"""`BalanceEnv`: one robot on one board, a brax environment with 441 discrete actions."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from mjx_balance import physics
from mjx_balance.config import ACTION_AXES, Config, RandomConfig, check, preset
from mjx_balance.plant import decision_ctrl, observation, standing_heights
from mjx_balance.scene import Scene, load_scene, model_fields
from mjx_balance.task import tilt
from mjx_balance.task.actions import action_table, apply_action
from mjx_balance.task.conditions import DRAWS, draw_conditions
from mjx_balance.task.observation import extend_history, observation_names
from mjx_balance.task.reward import failed, reward_terms
from mjx_balance.task.symmetry import Symmetries, symmetries


class BalanceEnv(Env):
    """A quadruped on a board that tilts in two axes (paper section 3).

    One step is one decision: `sim_steps` physics steps of MJX. `done` is 1 after a
    fall or at the time limit; `info["truncation"]` is 1 only at the time limit, so
    that `done * (1 - truncation)` marks true terminations. A done env is not reset
    by `step`: the observation it returns is the one before the reset.

    Written for one board; `jax.vmap` it over thousands.
    """

    def __init__(self, config: Config | None = None):
        """Builds the scene.

        Args:
          config: the preset "default" if none.

        Raises:
          ConfigError: if the config cannot be run.
        """
        self.config = check(config or preset("default"))
        self.scene: Scene = load_scene(self.config)
        self._table = action_table(self.config.task)
        self._randomised = self.config.random != RandomConfig()

    @functools.cached_property
    def _advance(self) -> physics.Advance:
        return physics.mjx_advance(self.scene)

    @property
    def observation_size(self) -> int:
        return len(observation_names(self.config.task, self.config.robot))

    @property
    def action_size(self) -> int:
        """Number of discrete actions."""
        return self.config.task.num_actions

    @property
    def action_factors(self) -> tuple[int, ...]:
        """The action index as a mixed-radix number: levels of roll, levels of pitch."""
        return (self.config.task.action_levels,) * ACTION_AXES

    @property
    def symmetries(self) -> Symmetries:
        """How observations and actions look in a mirror."""
        return symmetries(self.config.task, self.config.robot)

    @property
    def backend(self) -> str:
        return "mjx"

    def reset(self, rng: jax.Array) -> State:
        """Starts a fresh tilt scenario from the settled stance.

        Args:
          rng: PRNG key.

        Returns:
          State with obs (obs_size,).
        """
        task = self.config.task
        rng, key_conditions, key_noise = jax.random.split(rng, 3)
        state = physics.initial_state(self.scene)
        still = jnp.asarray(self.scene.stance.imu, jnp.float32)
        stand = jnp.asarray(standing_heights(self.config), jnp.float32)
        commanded = jnp.tile(stand, (task.command_history, 1))
        info = {
            "scenario": self._scenario(rng),
            "heights": stand,
            "commanded": commanded,
            "imu": jnp.tile(still, (task.history, 1)),
            "tilt": jnp.float32(0.0),
            "decision": jnp.int32(0),
            "truncation": jnp.float32(0.0),
        }
        if self._randomised:
            uniform = jax.random.uniform(key_conditions, (DRAWS,))
            info |= {
                "conditions": draw_conditions(self.config.random, self.config.robot, uniform),
                "noise_key": key_noise,
            }
        metrics = {
            name: jnp.float32(0.0)
            for name in ("tilt_deg", "fall", "reward_level", "reward_toward", "reward_fail")
        }
        obs = observation(self.config, self.scene, state.qpos, commanded, info["imu"])
        zero = jnp.float32(0.0)
        return State(state, obs, zero, zero, metrics, info)  # pyright: ignore[reportArgumentType]

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one decision.

        Args:
          state: from `reset` or `step`.
          action: () action index, 0 to action_size - 1.

        Returns:
          The state `ctrl_dt` later.
        """
        config, task = self.config, self.config.task
        info: dict[str, Any] = state.info
        fields: dict[str, jax.Array] = {}
        change = jnp.asarray(self._table)[action]
        last = info["commanded"][-1]
        heights = wanted = apply_action(task, config.robot, last, change)
        if self._randomised:
            late = info["conditions"].latency > 0
            heights = jnp.where(late, last, wanted)
            fields = model_fields(self.scene, info["conditions"])
        decision = info["decision"]
        ctrl = decision_ctrl(
            config, self.scene, info["scenario"], decision, info["heights"], heights
        )
        moved, motion = self._advance(state.pipeline_state, ctrl, fields)  # pyright: ignore

        fell = failed(task, motion.tilt).any()
        truncated = ~fell & (decision + 1 >= task.episode_length)
        # A diverged world has fallen; what is not a number must not reach the learner.
        moved, motion = jax.tree.map(jnp.nan_to_num, (moved, motion))
        after = motion.tilt.mean() if task.reward_tilt == "mean" else motion.tilt[-1]
        terms = reward_terms(task, info["tilt"], after, fell.astype(after.dtype))
        samples = motion.imu
        if self._randomised:
            key, key_noise = jax.random.split(info["noise_key"])
            noise = jax.random.normal(key_noise, samples.shape)
            samples = samples + info["conditions"].imu_noise * noise
            info = info | {"noise_key": key}
        imu = extend_history(info["imu"], samples)
        commanded = extend_history(info["commanded"], wanted[None])
        metrics = {
            "tilt_deg": motion.tilt.mean(),
            "fall": fell.astype(jnp.float32),
            **{f"reward_{name}": term for name, term in terms.items()},
        }
        info = info | {
            "heights": heights,
            "commanded": commanded,
            "imu": imu,
            "tilt": after,
            "decision": decision + 1,
            "truncation": truncated.astype(jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=moved,
            obs=observation(config, self.scene, moved.qpos, commanded, imu),
            reward=sum(terms.values()),
            done=(fell | truncated).astype(jnp.float32),
            metrics=state.metrics | metrics,
            info=info,
        )

    def _scenario(self, key: jax.Array) -> tilt.Scenario:
        """Draws the targets, and the age of the first.

        The random phase keeps thousands of boards from turning at the same time.
        """
        task = self.config.task
        count = tilt.num_targets(task, task.episode_length * task.ctrl_dt)
        key_disc, key_square, key_which, key_phase, key_size = jax.random.split(key, 5)
        share = jax.random.uniform(key_size, (2,))
        random = self.config.random
        limit = _between(task.max_incline, random.incline_max, share[0])
        rate = _between(task.board_rate, random.rate_max, share[1])
        disc = tilt.disc_targets(limit, *jax.random.uniform(key_disc, (2, count)))
        square = limit * jax.random.uniform(key_square, (count, 2), minval=-1.0)
        in_square = jax.random.bernoulli(key_which, task.square_share, (count, 1))
        targets = jnp.where(in_square, square, disc)
        # The board starts level, so the first target is one it has already reached.
        targets = targets.at[0].set(0.0)
        phase = jax.random.uniform(key_phase) * task.target_period
        return tilt.Scenario(targets, phase, rate)


def _between(least: float, most: float | None, share: jax.Array) -> jax.Array:
    """A share of the way from `least` to `most`; `least` if there is no `most`."""
    return jnp.float32(least) + (0.0 if most is None else most - least) * share
