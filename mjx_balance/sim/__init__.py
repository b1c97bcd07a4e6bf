"""Scene and physics engines."""
