# `make demo` and `make test` are all a fresh machine needs: Python 3.11 or later, pip, make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# Many processes load armcal: each would compile its sources anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-all bench lint types docs docs-commands dist clean

# The editable install is made anew when dependencies or entry points change.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,dev,docs]"
	touch $(READY)

demo: $(READY)
	$(BIN)/armcal run configs/lrm_arm/demo.yaml --out runs/demo

test: $(READY)
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not slow and not page" tests

test-all: $(READY)
	$(BIN)/python -m pytest -n 3 --dist worksteal tests

# The peers are not needed: without one its row says so.
bench: $(READY)
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[bench]"
	$(BIN)/python -m benchmarks

lint: $(READY)
	$(BIN)/ruff check framework plugins tests benchmarks docs/tools
	$(BIN)/ruff format --check framework plugins tests benchmarks docs/tools
	$(BIN)/python -m tests.words framework plugins docs README.md CONTRIBUTING.md

types: $(READY)
	$(BIN)/mypy

# What README.md and docs/ show: every command that is meant to be typed as it stands, and pages done word for word.
docs-commands: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m tests.docs_commands README.md docs
	$(BIN)/python -m pytest -n 2 -m page tests/framework/test_new_robot.py tests/framework/test_new_plugin.py

# The pages as a site that works without a network, in site/; its figures are made anew from real runs.
docs: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python docs/tools/figures.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

# Wheel and source distribution in dist/, the same bytes whenever and wherever they are built from the same tree.
dist: $(READY)
	rm -rf dist
	SOURCE_DATE_EPOCH=$${SOURCE_DATE_EPOCH:-1577836800} $(BIN)/python -m hatchling build -d dist

clean:
	rm -rf $(VENV) runs dist site .pytest_cache .mypy_cache .ruff_cache
