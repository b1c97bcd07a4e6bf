"""Output for people: tables, progress, figures and an HTML page. No JAX."""
