PYTHON ?= python3
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
BIN := .venv/bin
RUNTIME := .venv/runtime-installed
DEV := .venv/dev-installed
BASELINES := .venv/baselines-installed
DOCS := .venv/docs-installed
unexport PYTHONDONTWRITEBYTECODE  # where it is set, each of many processes would compile all that it imports
SCHEMA := $(BIN)/check-jsonschema --quiet --builtin-schema vendor
PYTEST := $(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder
INSTALL := VIRTUAL_ENV=.venv $(BIN)/uv pip install --quiet

.PHONY: help demo test slow lint count docs clean

help:
	@echo "make demo   simulate an office and a town, run both, compare the town with KISS-ICP and Open3D (within four minutes)"
	@echo "make test   run the tests, but for the slow ones"
	@echo "make slow   run the slow tests; make test ALL=1 runs both in one session"
	@echo "make lint   format, lint, type and import checks"
	@echo "make count  print how many files and lines each part has"
	@echo "make docs   build the documentation into build/docs; warnings are errors"
	@echo "make clean  remove the environment, logs and runs of the demo"

demo: $(BASELINES)
	$(BIN)/scanchain sequence get demo-office
	$(BIN)/scanchain run logs/demo-office.mcap --out runs/demo-office --force
	$(BIN)/scanchain view runs/demo-office --png runs/demo-office.png
	$(BIN)/scanchain sequence get demo-town
	$(BIN)/scanchain run logs/demo-town.mcap --out runs/demo-town --force
	$(BIN)/scanchain view runs/demo-town --png runs/demo-town.png
	$(BIN)/scanchain compare logs/demo-town.mcap --end 15 --methods plicp,kiss-icp,open3d-p2l --out runs/demo-compare --force
	@echo
	@echo "The comparison is runs/demo-compare/report.html."
	@echo "Look at the pictures in runs/, or open the recordings: $(BIN)/scanchain view runs/demo-town"

test: $(DEV)
	$(PYTEST) $(if $(ALL),,-m "not slow")

slow: $(DEV)
	$(PYTEST) -m slow

lint: $(DEV)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright
	PYTHONPATH=pipeline:viz $(BIN)/lint-imports
	$(SCHEMA).github-workflows .github/workflows/*.yml
	$(SCHEMA).github-issue-forms $(filter-out %/config.yml,$(wildcard .github/ISSUE_TEMPLATE/*.yml))
	$(SCHEMA).citation-file-format CITATION.cff

count:
	@git ls-files '*.py' | xargs wc -l | awk '$$2 != "total" { \
	  split($$2, part, "/"); room = part[2] == "scanchain" && part[4] ? part[1] "/" part[3] : part[1]; \
	  kind = part[1] ~ /pipeline|viz/ ? "product" : part[1]; \
	  lines[room] += $$1; files[room]++; if (kind == "product") { lines[kind] += $$1; files[kind]++ } } \
	  END { for (room in lines) printf "%7d lines %4d files  %s\n", lines[room], files[room], room }' | sort -k5
	@cat README.md CHANGELOG.md CONTRIBUTING.md docs/*.md | wc -c | awk '{ printf "%7.1f kB of documentation\n", $$1 / 1000 }'

docs: $(BASELINES) $(DOCS)
	$(BIN)/python -m sphinx -W --keep-going -q -d build/docs/.doctrees docs build/docs
	@! grep -rnE '<(script|link rel="stylesheet")[^>]*(src|href)="https?:' build/docs --include '*.html'  # works offline
	@echo "Open build/docs/index.html"

$(RUNTIME): pyproject.toml
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'Python 3.11 or newer is needed: make PYTHON=python3.12')"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(INSTALL) --editable .
	touch $@

$(BASELINES): pyproject.toml $(RUNTIME)
	$(INSTALL) --editable '.[baselines]'
	touch $@

$(DEV): pyproject.toml $(RUNTIME)
	$(INSTALL) --editable '.[baselines,evalio,cluster,remote,dev]'
	touch $@

$(DOCS): pyproject.toml $(RUNTIME)
	$(INSTALL) --editable '.[docs]'
	touch $@

clean:
	rm -rf .venv build logs runs/demo-office runs/demo-town runs/demo-office.png runs/demo-town.png runs/demo-compare
