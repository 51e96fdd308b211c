PYTHON ?= python3
BIN := .venv/bin
RUNTIME := .venv/runtime-installed
DEV := .venv/dev-installed

.PHONY: help demo test lint clean

help:
	@echo "make demo   simulate an office and a town, run both, print their accuracy (about two minutes once installed)"
	@echo "make test   run the whole test suite"
	@echo "make lint   format, lint, type and import checks"
	@echo "make clean  remove the environment, logs and runs of the demo"

demo: $(RUNTIME)
	$(BIN)/scanchain sequence get demo-office
	$(BIN)/scanchain run logs/demo-office.mcap --out runs/demo-office --force
	$(BIN)/scanchain view runs/demo-office --png runs/demo-office.png
	$(BIN)/scanchain sequence get demo-town
	$(BIN)/scanchain run logs/demo-town.mcap --out runs/demo-town --force
	$(BIN)/scanchain view runs/demo-town --png runs/demo-town.png
	@echo
	@echo "Look at the pictures in runs/, or open the recordings: $(BIN)/scanchain view runs/demo-town"

test: $(DEV)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

lint: $(DEV)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright
	$(BIN)/lint-imports

$(RUNTIME): pyproject.toml
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'Python 3.11 or newer is needed: make PYTHON=python3.12')"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(DEV): pyproject.toml $(RUNTIME)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv logs runs/demo-office runs/demo-town runs/demo-office.png runs/demo-town.png
