"""Runs the command line: `python -m mjx_balance` equals `mjx-balance`."""

import sys

from mjx_balance.cli import main

sys.exit(main())
