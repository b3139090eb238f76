# Every target sets itself up: all it needs is Python 3.11 or later with venv, and pip.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.ready
# of the tests: one process a core, with one thread each, up to eight; each begins with a part of its own,
# so that fixtures and imports of a file are made once, and takes from the others when it is done
PARALLEL := -n auto --maxprocesses 8 --dist worksteal
# compiled modules are kept, whatever is set: tests start some hundred processes that import FIDE
KEEP := PYTHONDONTWRITEBYTECODE=
# of `test-kernels`: what computes, and takes minutes.  Left out are the folders of tests that start
# browsers, renderers and other processes; what they compute is tested in these, and tests/README.md
# has their own last results.
NUMERIC := $(addprefix tests/,adapters/nevergrad adapters/optuna denoiser encoders extremes fide \
  lab/baselines lab/pretrained learning losses options population proposers runtime search space speed uncertainty validation views)
# with two threads, so in one process: the parts, and the optimizer
CORE := $(addprefix tests/,adapters/optuna denoiser encoders fide lab/pretrained losses options population proposers \
  search space speed uncertainty validation views)
# of `wheel`: all that a user starts, which finds out whether a file or an entry point is missing
OUTSIDE := $(addprefix tests/,adapters cli fide fitting lab/compare lab/report lab/run lab/suite lab/sweep learning losses package \
  recording renderers tasks/test_contract.py lab/watch)
# as an x86 CPU without AVX-512, and as one without AVX2
HASWELL := OPENBLAS_CORETYPE=Haswell ATEN_CPU_CAPABILITY=avx2 \
  NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL AVX512_SPR"
SANDYBRIDGE := OPENBLAS_CORETYPE=Sandybridge ATEN_CPU_CAPABILITY=default \
  NPY_DISABLE_CPU_FEATURES="X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
# builds of OpenCV whose files would be in the way of the required one; FIDE once required one of them
OPENCVS := opencv-python opencv-python-headless opencv-contrib-python
# of `docs`: installed when the site is first built, so that `make setup` stays as fast as it is
DOCS   := $(VENV)/.docs
SITE   := build/docs/html
# of `release`: tools that look at what was built
CHECKS := $(VENV)/.release
PIP    := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: addon setup demo test test-thorough test-kernels test-gpu lint format docs docs-links wheel release clean
.DEFAULT_GOAL := setup

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt fide_plugins/__init__.py  # which has the version
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "FIDE needs Python 3.11 or later; name one with: make PYTHON=python3.12 ..." >&2; exit 1; }
	@echo "Setting up $(VENV) (PyTorch is large: this can take some minutes) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) uninstall -qq -y $(OPENCVS) 2>/dev/null
	@$(PIP) install -qq -c constraints.txt -e ".[dev]"
	@touch $@
	@echo "Ready: $(BIN)/fide --help"

demo: setup
	@rm -rf runs/demo
	$(BIN)/fide run voronoi --size 112 --budget 4000 --out runs/demo
	@echo "Look at runs/demo/summary.png"

# The tests that take less than a second or two, and those that take more.
test: setup
	$(KEEP) OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q $(PARALLEL) -m "not slow and not thorough"

test-thorough: setup
	$(KEEP) OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q $(PARALLEL) -m "thorough and not slow"

# The same result on any CPU: other kernels of OpenBLAS, PyTorch and NumPy, and two threads.
test-kernels: setup
	$(KEEP) OMP_NUM_THREADS=1 $(HASWELL) $(BIN)/python -m pytest -q $(PARALLEL) $(NUMERIC)
	$(KEEP) OMP_NUM_THREADS=2 $(SANDYBRIDGE) $(BIN)/python -m pytest -q $(CORE)

# What computes on an NVIDIA GPU, in one process; CUDA does not see it in the other tests.
test-gpu: setup
	$(KEEP) $(BIN)/python -m pytest -q -m gpu

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(DOCS): $(STAMP)
	@$(PIP) install -qq -c constraints.txt -e ".[docs]"
	@touch $@

# The site, from nothing; a warning, such as of a link that leads nowhere, is an error.  Notebooks run
# again when they, FIDE or constraints.txt have changed: build/notebooks keeps what they wrote.
docs: $(DOCS)
	@rm -rf build/docs
	$(BIN)/python -m sphinx -q -W --keep-going -b html -d build/docs/doctrees docs $(SITE)
	$(BIN)/python docs/check_site.py $(SITE)
	$(BIN)/python docs/check_browser.py $(SITE)
	@echo "Open $(SITE)/index.html"

# Links that lead out of the site, which needs a network; the others are checked by `docs`.
docs-links: $(DOCS)
	$(BIN)/python -m sphinx -q -b linkcheck -d build/docs/doctrees docs build/docs/links

# Built into dist/ and tested away from this folder, as a user would have it.
wheel: setup
	@rm -rf dist build/wheel-test
	$(BIN)/python -m hatchling build
	@$(PYTHON) -m venv build/wheel-test
	@build/wheel-test/bin/python -m pip --disable-pip-version-check install -qq \
	  -c constraints.txt "$$(echo dist/*.whl)[dev]"
	cp -r tests examples docs README.md pyproject.toml build/wheel-test/
	cd build/wheel-test && OMP_NUM_THREADS=1 bin/python -P -m pytest -q $(PARALLEL) -o pythonpath= $(OUTSIDE)

$(CHECKS): $(STAMP)
	@$(PIP) install -qq -c constraints.txt -e ".[release]"
	@touch $@

# What is published, in dist/: the wheel that was tested, its source, notes, and what it depends on with licenses.
# A user installs from there: without extras, then with two of them for what README shows.
release: wheel $(CHECKS)
	@rm -rf build/release
	$(BIN)/twine check --strict dist/*.whl dist/*.tar.gz
	$(BIN)/check-wheel-contents dist/*.whl
	@$(PYTHON) -m venv build/release
	build/release/bin/python -m pip --disable-pip-version-check install -qq --pre -c constraints.txt \
	  --find-links dist fide-plugins
	cd build/release && bin/python -P ../../.ci/readme_code.py ../../README.md 1
	build/release/bin/python -m pip --disable-pip-version-check install -qq --pre -c constraints.txt \
	  --find-links dist 'fide-plugins[optuna,nevergrad]'
	cd build/release && bin/python -P ../../.ci/readme_code.py ../../README.md
	$(BIN)/cyclonedx-py environment build/release/bin/python --of JSON -o dist/sbom.json
	awk '/^## \[/ {n += 1} n == 1' CHANGELOG.md > dist/NOTES.md
	@ls dist

# The add-on for Blender, which needs nothing but Blender and an installed FIDE.
addon:
	@mkdir -p dist
	cd adapters/blender_addon/fide_fit && $(PYTHON) -m zipfile -c ../../../dist/fide-blender.zip \
	  __init__.py blender_manifest.toml render.py

clean:
	rm -rf build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
