"""Robots: their files, and what follows from them."""
