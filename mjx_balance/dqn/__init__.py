"""A Deep Q-Network for any brax `Env` with discrete actions."""

from mjx_balance.dqn.dqn import DQN, DQNSpec, TrainState
from mjx_balance.dqn.networks import QNetwork

__all__ = ["DQN", "DQNSpec", "QNetwork", "TrainState"]
