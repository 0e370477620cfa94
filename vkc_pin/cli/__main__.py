"""`python -m vkc_pin.cli` is `vkc-pin`."""

import sys

from vkc_pin.cli.process import main

sys.exit(main())
