"""What a person reads of a run: tables in a terminal, figures, and a page about it. No JAX."""
