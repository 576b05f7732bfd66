# make demo: set up and film a trained arm, demo.mp4.
# make train: set up and train MERL on reach_duplo for about ten minutes.
# make test: set up and pass the tests in their short form; make test-all runs the long forms too.
# make docs: set up and build the documentation site, docs/_build/index.html.
# All need nothing but Python 3.11 or 3.12, make, bash and a package index.

PYTHON := $(shell for p in python3.12 python3.11; do "$$p" --version >/dev/null 2>&1 && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
MINUTES := 10
PYTEST_FLAGS := --numprocesses 2 --dist worksteal --durations 10

.PHONY: help setup demo train test test-all docs clean

help:
	@sed -n 's/^# //p' Makefile

setup: $(VENV)/ready

$(VENV)/ready: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "merl needs python3.12 or python3.11 on the PATH, and finds neither: install one (Debian: apt-get install python3.11 python3.11-venv)" >&2; exit 2; }
	@echo "setting up $(VENV) with $(PYTHON): a few minutes, most of them for torch"
	@$(PYTHON) -m venv $(VENV) || { echo "$(PYTHON) cannot make a virtual environment: install its venv module (Debian: apt-get install $(PYTHON)-venv)" >&2; exit 2; }
	@bash install.sh $(BIN)/pip --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: setup
	@$(BIN)/merl evaluate pretrained/reach_duplo --episodes 3 --video demo.mp4

train: setup
	@$(BIN)/merl train reach_duplo --preset laptop --minutes $(MINUTES)

test: setup
	@$(BIN)/ruff check src tests benchmarks examples docs
	@$(BIN)/ruff format --check src tests benchmarks examples docs
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/pytest -m "not long" $(PYTEST_FLAGS)

test-all: setup
	@$(BIN)/ruff check src tests benchmarks examples docs
	@$(BIN)/ruff format --check src tests benchmarks examples docs
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/pytest $(PYTEST_FLAGS)

docs: setup
	@$(BIN)/sphinx-build -E -W --keep-going -q -b html docs docs/_build
	@echo "docs/_build/index.html"

clean:
	rm -rf $(VENV)
