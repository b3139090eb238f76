# Every target sets itself up: all it needs is Python 3.11 or later with venv, and pip.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.ready
# of the tests: one process a core, with one thread each, up to eight
PARALLEL := -n auto --maxprocesses 8
PIP    := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: setup demo test lint format wheel clean
.DEFAULT_GOAL := setup

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "FIDE needs Python 3.11 or later; name one with: make PYTHON=python3.12 ..." >&2; exit 1; }
	@echo "Setting up $(VENV) (PyTorch is large: this can take some minutes) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) install -qq -c constraints.txt -e ".[dev]"
	@touch $@
	@echo "Ready: $(BIN)/fide --help"

demo: setup
	@rm -rf runs/demo
	$(BIN)/fide run voronoi --size 112 --budget 4000 --seed 1 --out runs/demo
	@echo "Look at runs/demo/summary.png"

test: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q $(PARALLEL)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Built into dist/ and tested away from this folder, as a user would have it.
wheel: setup
	@rm -rf dist build/wheel-test
	$(BIN)/python -m hatchling build
	@$(PYTHON) -m venv build/wheel-test
	@build/wheel-test/bin/python -m pip --disable-pip-version-check install -qq \
	  -c constraints.txt "$$(echo dist/*.whl)[dev]"
	cp -r tests examples README.md pyproject.toml build/wheel-test/
	cd build/wheel-test && OMP_NUM_THREADS=1 bin/python -P -m pytest -q $(PARALLEL) -o pythonpath= tests

clean:
	rm -rf build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
