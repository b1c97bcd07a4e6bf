"""Physics engines: each moves a scene by one decision. `table.py` names them all."""
