# Everything runs in .venv, which the first target makes. Needs Python 3.10 or newer.
PYTHON ?= python3
TOOLS ?= pen,pliers,hammer
DEMO ?= demo
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

NODE_STAMP := tests/interop/node_modules/.installed

.PHONY: install demo test interop interop-rerun lint types docs clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 10) else "tooltip needs Python 3.10 or newer; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[all]" --group dev
	$(BIN)/python -m compileall -q tooltip_cli  # some environments forbid doing so on first use
	touch $@

demo: install
	$(BIN)/tooltip demo $(DEMO) --tools $(TOOLS) --jobs 2

test: install
	-@$(MAKE) --no-print-directory interop
	$(BIN)/python -m pytest -n 2

# An independent MCAP reader and axe-core for the tests of our files and pages; they skip without.
interop:
	@if command -v npm >/dev/null; then $(MAKE) --no-print-directory $(NODE_STAMP); \
	else echo "npm is not installed: the tests with its packages are skipped"; fi

$(NODE_STAMP): tests/interop/package.json
	npm install --prefix tests/interop --no-package-lock --no-audit --no-fund --silent
	touch $@

# Large (800 MB), so it is no part of the tests.
interop-rerun: install
	test -d .venv-rerun || $(PYTHON) -m venv .venv-rerun
	.venv-rerun/bin/python -m pip install --quiet "rerun-sdk>=0.30,<1"
	$(BIN)/python -m tests.interop.rerun_check .venv-rerun/bin/rerun

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy tooltip_cli tests docs

docs: install
	$(BIN)/python docs/make_cli_reference.py
	$(BIN)/python docs/make_parameter_tables.py

clean:
	rm -rf $(VENV) .venv-rerun tests/interop/node_modules demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
