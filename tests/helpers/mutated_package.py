"""Lets pytest import the copy of the package that mutmut changes, as a plugin of its runs.

The finder of the editable installation comes before `sys.path` and would import the unchanged
modules. Compiled modules, which the copy has not, are left to it.
"""

from __future__ import annotations

import sys

for finder in sys.meta_path:
    for modules in ("known_source_files", "submodule_search_locations"):
        getattr(finder, modules, {}).clear()
