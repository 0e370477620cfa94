"""Runs `vkc-pin` for `python -m vkc_pin.cli`."""

import sys

from vkc_pin.cli.process import main

sys.exit(main())
