"""A Deep Q-Network that knows no robot and trains on any discrete-action brax `Env`."""
