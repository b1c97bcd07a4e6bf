"""`python -m mjx_balance` is `mjx-balance`."""

import sys

from mjx_balance.cli import main

sys.exit(main())
