"""Suites, controllers and rollouts in plain MuJoCo."""
