# Needs python3 (3.11 or newer) and make; everything else is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TOOLS := .venv-tools
PIP := $(BIN)/python -m pip install --disable-pip-version-check
# The matrices are small; more threads only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
# Modules that are compiled once let every further command start three seconds sooner.
unexport PYTHONDONTWRITEBYTECODE
# A file stays in one process, so what its tests share is made once.
BY_FILE := --dist loadfile --no-loadscope-reorder
# What is installed for which purpose, as requirements/PURPOSE.txt lists it.
RUN := $(VENV)/.run
TEST := $(VENV)/.test
DEV := $(TEST) $(VENV)/.dev
DOCS := $(TEST) $(VENV)/.docs

.PHONY: demo loops test test-fast test-slow test-matrix lock audit fuzz fuzz-values faults coverage mutants check docs picture bench bench-full soak soak-live fairness clean

demo: $(RUN)
	@$(BIN)/fgtrack demo -o out/demo --overwrite

# Importing a module compiles its loops, unless numba has stored them; in two halves, else each worker would do all of it.
LOOPS = $(shell grep -rl -e '^@njit.' -e '^@shared.' --include='*.py' fgtrack | LC_ALL=C sort | sed 's/\.py$$//; s|/|.|g')
SMOOTHER_LOOPS = $(filter fgtrack.estimation.smoothing.%,$(LOOPS))
IMPORTED = $(foreach module,$(1),import $(module);)
loops: $(TEST)
	@$(BIN)/python -c '$(call IMPORTED,$(filter-out $(SMOOTHER_LOOPS),$(LOOPS)))' & \
	    $(BIN)/python -c '$(call IMPORTED,$(SMOOTHER_LOOPS))'; wait

test: loops
	$(BIN)/python -m pytest -n auto $(BY_FILE)

# The tests of the core: within a minute of processor time.
test-fast: $(TEST)
	$(BIN)/python -m pytest tests/unit -m 'not slow and not long'

# The tests marked slow, and the others with many more random examples.
test-slow: $(TEST)
	$(BIN)/python -m pytest -n auto $(BY_FILE) -m slow
	$(BIN)/python -m pytest -n auto $(BY_FILE) --hypothesis-profile=thorough

# Half an hour for each of the kinds of input; what is found is kept in out/fuzz. SECONDS=60 SEED=1 for others.
fuzz: $(TEST)
	$(BIN)/python -m pytest tests/fuzz/test_fuzz.py -n auto -m slow --fuzz-seconds $(or $(SECONDS),1800) --fuzz-seed $(or $(SEED),0)

# Some 20 minutes of a processor: 10,000 wrong values in files and live messages. CHANGES=1000 SEED=1 for others.
fuzz-values: $(TEST)
	$(BIN)/python -m pytest tests/fuzz/test_values.py -n auto -m slow --changes $(or $(CHANGES),10000) --fuzz-seed $(or $(SEED),0)

# Some 15 minutes: 400 kills, full disks, folders of others. KILLS=1000 SEED=1 for others.
faults: $(TEST)
	$(BIN)/python -m pytest tests/faults -n auto -m slow --kills $(or $(KILLS),100) --fuzz-seed $(or $(SEED),0)

coverage: $(DEV)
	$(BIN)/python -m pytest -n auto $(BY_FILE) --cov --cov-report=term-missing:skip-covered

# Hours; docs/testing.md tells how to take a sample.
mutants: $(DEV)
	$(BIN)/mutmut run
	$(BIN)/mutmut results

check: $(DEV)
	$(BIN)/ruff check fgtrack tests experiments
	$(BIN)/ruff format --check fgtrack tests experiments
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(DOCS) loops
	$(BIN)/python -m sphinx -W --keep-going -q -c docs . out/docs

# The imports between the folders, for docs/architecture.md.
picture: $(DEV)
	$(BIN)/python docs/_ext/import_graph.py

fairness: $(TEST)
	$(BIN)/python experiments/fairness.py -o out/fairness --jobs 2

# Some 5 minutes. AGAINST='COMMAND' runs the published implementation, too (docs/speed.md); PAGE=docs/speed.md updates the page.
BENCH = $(BIN)/python experiments/bench_speed.py -o out/speed $(if $(AGAINST),--published '$(AGAINST)') $(if $(PAGE),--page $(PAGE))
bench: $(TEST)
	$(BENCH)

# Every estimator, number of objects, lag and delay: takes several times as long.
bench-full: $(TEST)
	$(BENCH) --full

# A day of race, as fast as it goes, twice: hours. HOURS=6 ESTIMATOR=smoother-banded for others.
soak: $(TEST)
	$(BIN)/python experiments/bench_soak.py -o out/soak --hours $(or $(HOURS),24) --estimator $(or $(ESTIMATOR),ekf-replay)

# An hour, by the clock.
soak-live: $(TEST)
	$(BIN)/python experiments/bench_live.py -o out/live

# uv unpacks packages within seconds; where it cannot reach an index that pip is configured for, pip does it.
$(BIN)/uv: requirements/install.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fgtrack needs Python 3.11 or newer")'
	@echo "making the environment $(VENV)"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) --quiet --no-compile --require-hashes -r $<
	@touch $@

$(VENV)/.%: requirements/%.txt pyproject.toml $(BIN)/uv
	@echo "installing the packages of $< into $(VENV)"
	@$(BIN)/uv pip install --python $(VENV) --require-hashes -r $< || $(PIP) --require-hashes -r $<
	@$(BIN)/uv pip install --quiet --python $(VENV) --no-deps --no-build-isolation -e . || $(PIP) --no-deps --no-build-isolation -e .
	@touch $@

$(TOOLS):
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install --quiet --disable-pip-version-check uv pip-audit

# The newest versions that pyproject.toml allows, for every platform and Python from 3.11 on, the same in every file.
COMPILE = $(TOOLS)/bin/uv pip compile --universal --python-version 3.11 --generate-hashes --no-annotate \
    --no-emit-index-url --quiet --custom-compile-command "make lock"
# Without rivals, foxglove and live their tests are skipped.
TESTED := --extra test --extra rivals --extra foxglove --extra live
lock: $(TOOLS)
	rm -f $(TOOLS)/all.txt
	$(COMPILE) requirements/install.in pyproject.toml $(TESTED) --extra dev --extra docs -o $(TOOLS)/all.txt
	$(COMPILE) -c $(TOOLS)/all.txt requirements/install.in -o requirements/install.txt
	$(COMPILE) -c $(TOOLS)/all.txt pyproject.toml -o requirements/run.txt
	$(COMPILE) -c $(TOOLS)/all.txt pyproject.toml $(TESTED) -o requirements/test.txt
	for extra in dev docs; do \
	    $(COMPILE) -c $(TOOLS)/all.txt pyproject.toml --extra $$extra -o requirements/$$extra.txt || exit 1; done

# Known weaknesses of what is locked; asks pypi.org.
audit: $(TOOLS)
	for lock in requirements/*.txt; do $(TOOLS)/bin/pip-audit --require-hashes --disable-pip -r $$lock || exit 1; done

# The tests with the oldest and newest versions allowed, and with those locked on every Python that is installed.
test-matrix: $(TOOLS)
	.ci/matrix $(TOOLS)/bin/uv

clean:
	rm -rf $(VENV) $(VENV)-* out build *.egg-info
