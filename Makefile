# make demo: plan the door and look at it; make test: lint, types, tests, documentation; make test-long: the tests that take
# longest; make docs: the documentation alone; make smoke-lowest, make test-lowest: scripts for each extra, and tests, with the
# lowest version of every dependency that has a range.
# Each sets up .venv first, where it is not yet.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Of pip's packages few modules are imported: with --no-compile, Python compiles those alone.
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: demo test test-long test-lowest smoke-lowest smoke pytest lint docs clean
# The extras that a goal needs are installed with the other packages, while this one is compiled.
test test-long: EXTRAS := test docs
lint: EXTRAS := test
docs: EXTRAS := docs
.DELETE_ON_ERROR:

demo: $(VENV)/installed.stamp
	@mkdir -p out
	$(BIN)/vkc-pin plan door --set door.hinge=1.2 --html out/door.html --save out/door.npz --json out/door.json --plots out

# Python compiles each module that it imports once, not in every process, wherever the environment forbids that: tests start many.
export PYTHONDONTWRITEBYTECODE :=

# One process a core, each with one thread; files stay whole, since their tests share problems and plans.
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

test: $(VENV)/test.stamp $(VENV)/docs.stamp
	@$(MAKE) --no-print-directory --jobs=2 lint docs pytest

# Begins when lint has succeeded, beside the documentation, which takes longer and only one core.
pytest: $(VENV)/test.stamp
	$(PYTEST) -m "not long"

# These leave the notebooks that they run in out/notebooks; the documentation shows them with what came out.
test-long: $(VENV)/test.stamp $(VENV)/docs.stamp
	$(PYTEST) -m long

# `make test` installs the highest version that a range allows, these the lowest, which a user's other packages may demand. `peers`
# is left out: it is large and serves one experiment.
LOWEST := VENV=out/venv-lowest VERSIONS=lowest EXTRAS="test docs cluster data import notebook ros sim"
smoke-lowest:
	@$(MAKE) --no-print-directory $(LOWEST) smoke

test-lowest: smoke-lowest
	@$(MAKE) --no-print-directory $(LOWEST) docs pytest

# Every script in a folder of its own, without the checkout on its path.
smoke: $(VENV)/installed.stamp
	@work=$$(mktemp -d) && trap 'rm -rf "$$work"' EXIT && for script in $(CURDIR)/tests/installed/*.py; do \
	  echo "$$script" && mkdir "$$work/folder" && (cd "$$work/folder" && \
	    PYTHONPATH=$(CURDIR)/tests VKC_PIN_CACHE="$$work/cache" $(abspath $(BIN))/python "$$script" > "$$work/output" 2>&1) || \
	    { cat "$$work/output" >&2; exit 1; }; rm -rf "$$work/folder"; \
	done

docs: $(VENV)/docs.stamp
	$(BIN)/python -m sphinx -q -W --keep-going -c docs -d out/doctrees . out/site
	@echo "The documentation is at out/site/index.html"

lint: $(VENV)/test.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check --quiet
	$(BIN)/mypy
	$(BIN)/mypy --exclude /test_ tests/benchmarks
	$(BIN)/lint-imports --no-cache
	$(BIN)/zizmor --offline --quiet .github/workflows

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis mutants
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# What a machine must have; says what to install where it has not. Usage: $(call need,shell test,what is missing,packages)
need = @{ $(1); } >/dev/null 2>&1 || { echo "$(2) (Debian, Ubuntu: apt install $(3))" >&2; exit 1; }

$(VENV)/created.stamp:
	$(call need,$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))',Python 3.11 or newer is needed; choose one with make PYTHON=...,python3)
	$(call need,$(PYTHON) -c 'import ensurepip$(,) venv',Python's venv module is needed,python3-venv)
	$(call need,$(PYTHON) -c '$(has_headers)',Python's headers are needed,python3-dev)
	$(call need,command -v "$${CXX:-c++}" || command -v g++,A C++ compiler is needed,g++)
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

, := ,
has_headers = import pathlib, sys, sysconfig; sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())

# The package is installed from this checkout: Python files are used as they stand, so only these need it again.
COMPILED := $(wildcard vkc_pin/*/*/*.cpp vkc_pin/*/*/*.hpp)
$(VENV)/installed.stamp: pyproject.toml CMakeLists.txt $(COMPILED) | $(VENV)/created.stamp
	@echo "Installing vkc-pin and what it needs into $(VENV); compiling takes a minute or two"
	@$(listed) build-system requires > $(VENV)/build-packages.txt
	@$(listed) project dependencies > $(VENV)/packages.txt
	@$(foreach extra,$(EXTRAS),$(listed) project optional-dependencies $(extra) >> $(VENV)/packages.txt &&) true
	$(PIP) install --no-compile --requirement $(VENV)/build-packages.txt --constraint $(VENV)/packages.txt cmake ninja
	@# The other packages are installed while this one is compiled, against what is in $(VENV) already.
	$(PIP) install --no-compile --requirement $(VENV)/packages.txt & others=$$!; \
	$(PIP) install --no-compile --no-deps --no-build-isolation --editable . && wait $$others
	@touch $@ $(EXTRAS:%=$(VENV)/%.stamp)

# An extra that was not installed just now.
$(VENV)/test.stamp $(VENV)/docs.stamp: $(VENV)/%.stamp: $(VENV)/installed.stamp
	@{ [ -e $@ ] && [ ! $@ -ot $< ]; } || { $(listed) project optional-dependencies $* > $(VENV)/$*-packages.txt && \
	  $(PIP) install --no-compile --requirement $(VENV)/$*-packages.txt; }
	@touch $@

# Prints requirements of pyproject.toml: asking pip for '.[test]' would compile the package once more. With VERSIONS=lowest, a range
# such as ">=3.8,<5" becomes "==3.8".
listed = $(BIN)/python -c '$(list_requirements)'
list_requirements = import functools, re, sys, tomllib; \
  found = functools.reduce(dict.get, sys.argv[1:], tomllib.load(open("pyproject.toml", "rb"))); \
  lowest = [re.sub(r">=([\w.]+)(,<[\w.]+)?", r"==\1", text) for text in found]; \
  print(*(lowest if "$(VERSIONS)" == "lowest" else found), sep="\n")
