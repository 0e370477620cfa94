#!/bin/sh
# scikit-build-core 1.1.2: an editable package cannot be replaced by one on PYTHONPATH.
#
# Behaviour: with a package installed by `pip install --editable`, another copy of it in a folder on
# PYTHONPATH is not imported, because the finder of the editable package is the first of
# sys.meta_path. Timings of two versions by PYTHONPATH alone compare the editable one with itself.
#
# One would guess: the folder on PYTHONPATH, as with setuptools 80.9.0, which adds the project's
# folder at the end of sys.path.
#
# Source: scikit-build/scikit-build-core, src/scikit_build_core/resources/_editable_redirect.py
# (install: sys.meta_path.insert(0, ...)); setuptools' user guide, "Development Mode".
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for backend in scikit_build_core.build setuptools.build_meta; do
  case $backend in
    scikit*) requires='"scikit-build-core==1.1.2"' expected=editable ;;
    *) requires='"setuptools==80.9.0"' expected=other ;;
  esac
  work="$folder/$backend"
  mkdir -p "$work/project/src/sample" "$work/other/sample"
  echo 'place = "editable"' > "$work/project/src/sample/__init__.py"
  echo 'place = "other"' > "$work/other/sample/__init__.py"
  cat > "$work/project/pyproject.toml" <<TOML
[build-system]
requires = [$requires]
build-backend = "$backend"

[project]
name = "sample"
version = "1.0"

[tool.scikit-build]
wheel.cmake = false
wheel.packages = ["src/sample"]

[tool.setuptools]
package-dir = {"" = "src"}
packages = ["sample"]
TOML
  python3 -m venv "$work/venv"
  "$work/venv/bin/pip" install --quiet --editable "$work/project"
  place=$(PYTHONPATH="$work/other" "$work/venv/bin/python" -c "import sample; print(sample.place)")
  echo "$backend: $place"
  test "$place" = "$expected"
done
