# Two commands set everything up on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# See torchrefrac/launch.py: waiting OpenMP threads must not starve other processes.
export OMP_WAIT_POLICY ?= PASSIVE

.PHONY: demo test test-slow lint lint-tests docs examples bench bench-baseline clean

demo: $(READY)
	$(BIN)/torchrefrac -m scene=tank_small model=none,radial,refractive dense=patch out=outputs/demo

# One worker for each core, up to eight, and one thread for each worker: more of them only wait for each other.
test: lint docs
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "not slow" -n auto --maxprocesses 8 --dist worksteal

test-slow: $(READY)
	$(BIN)/pytest -m slow

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads
	$(BIN)/lint-imports

# The types of the tests, which take what they like from fakes and fixtures.
lint-tests: $(READY)
	$(BIN)/pyright -p tests

# The documentation, into site/. What a page lacks, or links to and is not there, is an error (strict, in mkdocs.yml).
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# The examples are run, and their pages and notebooks in docs/examples/ written again: some five minutes.
examples: $(READY)
	$(BIN)/python -m tools.pages

# Needs an idle machine and half an hour; bench-baseline writes what it measures into tools/bench/baseline.json.
bench: $(READY)
	$(BIN)/python tools/bench/baseline.py

bench-baseline: $(READY)
	$(BIN)/python tools/bench/baseline.py --write

clean:
	rm -rf $(VENV) outputs/* site .pytest_cache .ruff_cache

# Remade whenever the versions or the package's own requirements change.
$(READY): constraints.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[cluster,colmap,dev,docs,geo,hloc,sweep]"
	@touch $@
