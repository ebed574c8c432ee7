# Shortcuts; everything is done by pip and by the package's own command, rhp.
# Another Python: make PYTHON=python3.12 demo

PYTHON ?= python3.11
BIN := .venv/bin
# Another Python needs another set-up.
INSTALLED := .venv/installed-$(notdir $(PYTHON))

.PHONY: help demo test lint format

help:
	@echo "make demo    set up, then run scenarios/three_boxes.yaml in Meshcat"
	@echo "make test    set up, then lint and all quick tests"
	@echo "make lint    ruff and mypy alone"
	@echo "make format  let ruff format the code"

demo: $(INSTALLED)
	$(BIN)/rhp run scenarios/three_boxes.yaml

test: lint
	$(BIN)/pytest -q

lint: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c "" || \
	  { echo "$(PYTHON) does not run: choose another, make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv --clear .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@
