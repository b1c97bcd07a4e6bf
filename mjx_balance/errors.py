"""What a command ends with, besides 0, and the kind of error that is its user's to mend."""

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130


def how_to_install(extra: str) -> str:
    """Where an extra of ours comes from: the package is on no index."""
    return (
        f"the extra {extra} brings it: `pip install -e '.[{extra}]'` in a checkout, or "
        f"`pip install 'WHEEL[{extra}]'`"
    )


class InputError(ValueError):
    """Something given that cannot be used; the message, one sentence, says what and why."""
