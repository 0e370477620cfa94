#!/bin/sh
# sphinx 9.0.4: a page of N functions costs N² comparisons of names if their annotations are not
# documented in the project.
#
# Behaviour: every name in a signature that the Python domain does not know exactly, such as ndarray
# of another project, is compared with the end of the name of each documented object. Twice as many
# functions with such an annotation take four times as many comparisons.
#
# One would guess: one look-up by the last part of the name, whose cost does not depend on the number
# of objects, so that twice as many functions take twice as many.
#
# Source: sphinx-doc/sphinx, sphinx/domains/python/__init__.py, PythonDomain.find_obj (searchmode 1:
# "fuzzy" searching among all objects).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install "sphinx==9.0.4"
cat > "$folder/count.py" <<'PYTHON'
import cProfile
import pstats
import sys
from pathlib import Path

from sphinx.application import Sphinx


def count_comparisons(functions: int) -> int:
    """Return how often names are compared by their ends for a page of functions."""
    folder = Path(sys.argv[1]) / str(functions)
    folder.mkdir()
    entries = [f".. py:function:: f{k}(array: ndarray)\n" for k in range(functions)]
    (folder / "index.rst").write_text("Page\n====\n\n" + "\n".join(entries))
    (folder / "conf.py").write_text("")
    app = Sphinx(folder, folder, folder / "out", folder / "trees", "dummy", status=None, warning=None)
    profile = cProfile.Profile()
    profile.runcall(app.build)
    stats = pstats.Stats(profile).stats
    calls = [entry[0] for (_, _, name), entry in stats.items() if "'endswith' of 'str'" in name]
    return sum(calls)


few, many = (count_comparisons(number) for number in (400, 800))
print(f"comparisons for 400 and 800 functions: {few}, {many}")
sys.exit(0 if many > 3.5 * few else 1)
PYTHON
"$folder/venv/bin/python" "$folder/count.py" "$folder"
