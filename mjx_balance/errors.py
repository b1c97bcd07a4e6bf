"""What a command ends with, besides 0, and the kind of error that is its user's to mend."""

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130


class InputError(ValueError):
    """Something given that cannot be used; the message, one sentence, says what and why."""
