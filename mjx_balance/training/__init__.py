"""A run: its devices, its loop, its checkpoints, and at the end a policy and its evaluation."""
