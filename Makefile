# `make demo` and `make test` are all a fresh machine needs: Python 3.11 or later, pip, make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test test-all bench lint types docs-commands clean

# The editable install is made anew when dependencies or entry points change.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,dev]"
	touch $(READY)

demo: $(READY)
	$(BIN)/armcal run configs/lrm_arm/demo.yaml --out runs/demo

test: $(READY)
	$(BIN)/python -m pytest -n 2 -m "not slow" tests

test-all: $(READY)
	$(BIN)/python -m pytest -n 2 tests

# The peers are not needed: without one its row says so.
bench: $(READY)
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[bench]"
	$(BIN)/python -m benchmarks

lint: $(READY)
	$(BIN)/ruff check framework plugins tests benchmarks
	$(BIN)/ruff format --check framework plugins tests benchmarks

types: $(READY)
	$(BIN)/mypy

# Every command of README.md and docs/ that is meant to be typed as it stands.
docs-commands: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m tests.docs_commands README.md docs

clean:
	rm -rf $(VENV) runs dist .pytest_cache .mypy_cache .ruff_cache
