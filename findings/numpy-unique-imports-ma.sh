#!/bin/sh
# numpy 2.4.6: the first plain `np.unique` of a process imports the masked arrays.
#
# Behaviour: `import numpy` leaves `numpy.ma` for later. `np.unique(a)` of a plain array of integers
# imports it, which takes longer than some programs' first result: 9 ms from bytecode, 30 ms
# without. `np.unique(a, return_index=True)` of the same array does not import it.
#
# One would guess: an array that is no masked one needs no masked arrays, and the call that returns
# less costs less. Whoever counts milliseconds until the first result finds this import below a line
# of his own that has nothing to do with masked arrays.
#
# Source: numpy/numpy, numpy/lib/_arraysetops_impl.py: without optional outputs, `_unique1d` asks
# `np.ma.is_masked(ar)` before it takes the path by hash table; `numpy.__getattr__` imports `numpy.ma`
# on first use.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np

numbers = np.array([3, 1, 3])
at_import = "numpy.ma" in sys.modules
np.unique(numbers, return_index=True)
with_index = "numpy.ma" in sys.modules
np.unique(numbers)
plain = "numpy.ma" in sys.modules
print(f"imported by numpy: {at_import}, with indices: {with_index}, by plain unique: {plain}")
raise SystemExit((at_import, with_index, plain) != (False, False, True))
PYTHON
