"""Pictures and windows of a scene."""
