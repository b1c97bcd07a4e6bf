"""Exit codes of the commands, and the base class of errors in the user's input."""

from typing import ClassVar

from mjx_balance.text import MESSAGE, shorten

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130


def how_to_install(extra: str) -> str:
    """Returns the sentence that tells how to install an extra; the package is on no index."""
    return (
        f"the extra {extra} brings it: `pip install -e '.[{extra}]'` in a checkout, or "
        f"`pip install 'WHEEL[{extra}]'`"
    )


class InputError(ValueError):
    """Invalid input; the message is one sentence with the value, the reason and a remedy.

    Values and names in it may come from strangers, so that it is shortened and printable.
    """

    limit: ClassVar[int] = MESSAGE  #: greatest length of the message, characters

    def __init__(self, message: object = ""):
        super().__init__(shorten(message, self.limit, tail=self.limit // 3))
