# Needs python3 (3.11 or newer) and make; everything else is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The matrices are small; more threads only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test test-slow check docs bench clean

demo: $(STAMP)
	$(BIN)/fgtrack demo -o out/demo --overwrite

test: $(STAMP)
	$(BIN)/python -m pytest

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow

check: $(STAMP)
	$(BIN)/ruff check fgtrack tests experiments
	$(BIN)/ruff format --check fgtrack tests experiments
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -c docs . out/docs
	$(BIN)/python -m pytest tests/integration/test_docs.py

bench: $(STAMP)
	$(BIN)/python -m pytest experiments/bench_*.py -o addopts= -p no:warnings --benchmark-only -q -s

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fgtrack needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test,dev]'
	touch $@

clean:
	rm -rf $(VENV) out build *.egg-info
