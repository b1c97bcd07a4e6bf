"""Robots: TOML files, and the bodies and numbers that are built from them."""
