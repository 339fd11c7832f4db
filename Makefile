# The two commands: make demo, make test. Everything runs in .venv, installed from requirements.lock.
PYTHON ?= python3.11
BIN := .venv/bin
INSTALLED := .venv/installed

.PHONY: demo test check bench bench-hidden lock clean
.DEFAULT_GOAL := test

# setuptools warns that it will drop `compat` one day: nothing that who runs this can do about.
$(INSTALLED): requirements.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "socast needs $(PYTHON); name another with make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
	  --config-settings editable_mode=compat -e .
	touch $@

demo: $(INSTALLED)  ## a shift of several cars, live over Zenoh, in this terminal
	$(BIN)/socast demo

test: $(INSTALLED)  ## the whole test suite
	$(BIN)/python -m pytest

check: $(INSTALLED)  ## lint, types and the examples in docstrings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest --doctest-modules core stream tools

bench: $(INSTALLED)  ## ratios of speed, into bench.json and BENCHMARKS.md
	$(BIN)/python -m tools.bench

bench-hidden: $(INSTALLED)  ## whether diagnosis finds what a simulation hides, into bench-hidden.json and BENCHMARKS.md
	$(BIN)/python -m tools.bench.hidden $(OPTIONS)

lock: $(INSTALLED)  ## pin anew what pyproject.toml asks for
	$(BIN)/pip-compile --quiet --extra dev --allow-unsafe --generate-hashes --strip-extras --no-emit-index-url \
	  --no-emit-trusted-host --no-emit-find-links --no-header -o requirements.lock pyproject.toml

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis bench.json bench-hidden.json
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
