"""Pictures, videos and windows of a scene."""
