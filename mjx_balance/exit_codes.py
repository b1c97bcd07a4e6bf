"""What the command line ends with, besides 0."""

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130
