# Everything runs in .venv, which the first target makes. Needs Python 3.10 or newer.
PYTHON ?= python3
TOOLS ?= pen,pliers,hammer
DEMO ?= demo
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo test lint types docs clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 10) else "tooltip needs Python 3.10 or newer; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[all]" --group dev
	touch $@

demo: install
	$(BIN)/tooltip demo $(DEMO) --tools $(TOOLS) --jobs 2

test: install
	$(BIN)/python -m pytest -n 2

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy tooltip_cli tests docs

docs: install
	$(BIN)/python docs/make_cli_reference.py
	$(BIN)/python docs/make_parameter_tables.py

clean:
	rm -rf $(VENV) demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
