#!/bin/sh
# pytest-xdist 3.8.0 with pytest 9.2.0: a failure that ends a distributed run is no failed test.
#
# Behaviour: `pytest -x` returns 1 for a failing test, and so does `pytest -n 2`. `pytest -x -n 2`
# returns 2, as if the user had interrupted the run, for one worker as for two.
#
# One would guess: 1, which pytest documents as "tests were collected and run but some of the tests
# failed". A script that tells failures from interruptions and internal errors by the exit code,
# such as one that counts which planted faults the tests notice, takes every failure for an error.
#
# Source: pytest-dev/pytest-xdist, src/xdist/dsession.py: the end of a run by `maxfail` is raised as
# `Interrupted`, a subclass of KeyboardInterrupt, where pytest itself raises `Session.Failed`.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pytest==9.2.0 pytest-xdist==3.8.0
cat > "$folder/test_it.py" <<'PYTHON'
def test_one():
    assert False


def test_two():
    pass
PYTHON
cd "$folder"

exit_code() {
    code=0
    venv/bin/python -m pytest -q "$@" test_it.py > /dev/null 2>&1 || code=$?
    echo "$code"
}

first=$(exit_code -x)
distributed=$(exit_code -n 2)
both=$(exit_code -x -n 2)
echo "pytest -x: $first; pytest -n 2: $distributed; pytest -x -n 2: $both, expected 1"
[ "$first" = 1 ] && [ "$distributed" = 1 ] && [ "$both" = 2 ]
