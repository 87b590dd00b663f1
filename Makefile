# Two commands set everything up on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# See torchrefrac/launch.py: waiting OpenMP threads must not starve other processes.
export OMP_WAIT_POLICY ?= PASSIVE

.PHONY: demo test test-slow lint bench bench-baseline clean

demo: $(READY)
	$(BIN)/torchrefrac -m scene=tank_small model=none,radial,refractive dense=patch out=outputs/demo

test: lint
	$(BIN)/pytest -m "not slow"

test-slow: $(READY)
	$(BIN)/pytest -m slow

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# Needs an idle machine and half an hour; bench-baseline writes what it measures into tools/bench/baseline.json.
bench: $(READY)
	$(BIN)/python tools/bench/baseline.py

bench-baseline: $(READY)
	$(BIN)/python tools/bench/baseline.py --write

clean:
	rm -rf $(VENV) outputs/* .pytest_cache .ruff_cache

# Remade whenever the versions or the package's own requirements change.
$(READY): constraints.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,colmap,geo,sweep]"
	@touch $@
