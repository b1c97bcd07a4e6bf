"""Physics engines: each moves a scene by one decision."""
