"""Trains a policy: `python train.py [--preset NAME] [--seed N] ...` is `mjx-balance train ...`."""

import sys

from mjx_balance.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
