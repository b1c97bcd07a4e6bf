"""A run: its devices, its loop, its checkpoints, and at the end a policy and its evaluation."""

from mjx_balance.training.checkpoints import CheckpointError
from mjx_balance.training.run import Interrupted, train

__all__ = ["CheckpointError", "Interrupted", "train"]
