"""A Deep Q-Network for any brax `Env` with discrete actions, or with actions from -1 to 1."""

from mjx_balance.dqn.dqn import DQN, DQNSpec, Loss, TrainState, td_error
from mjx_balance.dqn.networks import Network, QNetwork

__all__ = ["DQN", "DQNSpec", "Loss", "Network", "QNetwork", "TrainState", "td_error"]
