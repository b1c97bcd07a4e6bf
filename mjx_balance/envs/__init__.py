"""The task as an environment: brax, NumPy, Gymnasium."""
