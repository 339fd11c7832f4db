# The two commands: make demo, make test. Everything runs in .venv: what the commands need is installed from
# requirements.lock, and what tests and documentation need beside it, at the first of their targets, from
# requirements-dev.lock.

# Versions of Python that the wheels of the lock files serve, newest first; `make lock` checks them.
PYTHONS := 3.14 3.13 3.12 3.11
# The newest of them on this machine that can make a virtual environment; `make PYTHON=...` names another.
PYTHON ?= $(shell for version in $(PYTHONS); do \
  python$$version -c 'import ensurepip, venv' 2>/dev/null && echo python$$version && break; done)
BIN := .venv/bin
RUNS := .venv/runs
INSTALLED := .venv/installed
UV := $(BIN)/python -m uv --quiet
INSTALL := $(UV) pip install --python $(BIN)/python --require-hashes
COMPILE := $(UV) pip compile --python-version 3.11.5 --generate-hashes --no-header --no-annotate
EXTRAS := --extra bridge --extra checkout --extra cluster --extra service --extra workbench

.PHONY: demo test check lint types examples docs bench figures lock clean
.DEFAULT_GOAL := test

# setuptools warns that it will drop `compat` one day; a user of this file can do nothing about it.
$(RUNS): requirements-uv.lock requirements.lock pyproject.toml
	@test -n "$(PYTHON)" && command -v "$(PYTHON)" >/dev/null || { \
	  echo "socast needs one of Python $(PYTHONS) with the venv module; install it, or name one: make PYTHON=..."; exit 1; }
	@echo "installing into .venv with $$($(PYTHON) --version) from $$(command -v $(PYTHON))"
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-uv.lock
	$(INSTALL) -r requirements.lock
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
	  --config-settings editable_mode=compat -e .
	$(BIN)/python -m socast.tools.terminal.kernels
	touch $@

$(INSTALLED): $(RUNS) requirements-dev.lock
	$(INSTALL) -r requirements-dev.lock
	touch $@

demo: $(RUNS)  ## a shift of several cars, live over Zenoh, in this terminal
	$(BIN)/socast demo

test: $(INSTALLED)  ## the whole test suite, in parallel
	$(BIN)/python -m pytest -n auto --dist loadfile --max-worker-restart 0

check: lint types examples docs  ## all of the four; `make -j2 check` runs them beside each other

lint: $(INSTALLED)  ## the rules of ruff, and its format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)  ## the types of all code, by two processes
	$(BIN)/mypy -n 2

examples: $(INSTALLED)  ## the examples in docstrings, by one process: each would import all of socast
	$(BIN)/python -m pytest --doctest-modules socast

docs: $(INSTALLED)  ## the documentation, into build/docs; a warning is an error
	$(BIN)/sphinx-build -W --keep-going -n -q -j auto -b html docs build/docs

bench: $(INSTALLED)  ## ratios of speed, into BENCHMARKS.md
	$(BIN)/python -m socast.tools.bench

figures: $(INSTALLED)  ## measure every figure of the pages again; make figures ONLY="speed league" measures some
	$(BIN)/python -m socast.tools.bench.figures $(if $(ONLY),--only "$(ONLY)") $(OPTIONS)

lock: $(INSTALLED)  ## pin anew what pyproject.toml asks for
	$(COMPILE) $(EXTRAS) -o requirements.lock pyproject.toml
	$(COMPILE) --all-extras -c requirements.lock -o requirements-dev.lock pyproject.toml
	echo uv | $(COMPILE) -o requirements-uv.lock -
	for version in $(PYTHONS); do \
	  $(INSTALL) --dry-run --no-deps --python-version $$version.5 --only-binary :all: --target build/lock \
	    -r requirements-dev.lock && echo "the lock files serve Python $$version"; done

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis build bench-hidden.json
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
