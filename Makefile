# `make` or `make help` lists the targets; every target sets up what it needs by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SCALE ?= quick
PYTEST := $(BIN)/python -m pytest
PIP := $(BIN)/python -m pip install --quiet --no-compile
WORKERS ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)

# Without bytecode each process would compile all of torch again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup figures paper searches smoke report verify test test-all lint docs bench \
	bench-peers clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(READY) ## install everything into .venv, at the exact versions of constraints.txt

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "bcrl needs Python 3.11 or newer; use make PYTHON=python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --constraint constraints.txt --editable '.[dev]'
	@touch $@

figures: $(READY) ## run the paper's experiments with 3 seeds per method and draw the figures
	$(BIN)/bcrl -m experiment=fig1,fig2,fig4 scale=quick workers=$(WORKERS)
	$(BIN)/bcrl-report --scale quick

paper: $(READY) ## the same with the paper's number of seeds (one hour on two cores)
	$(BIN)/bcrl -m experiment=fig1,fig2,fig4 scale=paper workers=$(WORKERS)
	$(BIN)/bcrl-report --scale paper

searches: $(READY) ## the searches of appendix C.3 on separate seeds, with summary tables
	$(BIN)/bcrl -m experiment=search_target_update,search_offset,search_nu workers=$(WORKERS)
	$(BIN)/bcrl-report --scale search

smoke: $(READY) ## every variant in seconds, then the report
	$(BIN)/bcrl -m experiment=fig1,fig2,fig4 scale=smoke workers=$(WORKERS)
	$(BIN)/bcrl-report --scale smoke

report: $(READY) ## draw figures, claims and one HTML page from runs/; SCALE=paper
	$(BIN)/bcrl-report --scale $(SCALE)

verify: $(READY) ## check that every result in runs/ is complete, unchanged and in its place
	$(BIN)/bcrl-verify

test: $(READY) ## the fast tests (about 4 minutes on two cores)
	$(PYTEST) --numprocesses 2 -m "not slow and not slurm and not browser"

# Tests share the cores among processes, and a benchmark has one.
test test-all bench-peers: export OMP_NUM_THREADS = 1
bench-peers: export RAYON_NUM_THREADS = 1

test-all: $(READY) ## all tests, with the fast ones' coverage of the package
	$(PYTEST) --numprocesses 4 --dist worksteal \
	  --cov=bcrl --cov-report=term --cov-fail-under=90

lint: $(READY) ## style, spelling, layers of imports, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell bcrl bench conf docs examples research *.md
	$(BIN)/lint-imports
	$(BIN)/mypy

docs: $(READY) ## build the documentation site into site/, without network; links are checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(READY) ## measure speed, as ratios against a plain implementation in one run
	$(BIN)/python bench/forest.py
	$(BIN)/python bench/iteration.py
	$(BIN)/python bench/growth.py
	$(BIN)/python bench/dqn.py
	$(BIN)/python bench/methods.py
	$(BIN)/python bench/checkpoints.py
	$(BIN)/python bench/agents.py
	$(BIN)/python bench/classic.py
	test ! -d runs/paper || $(BIN)/python bench/paper.py

# MushroomRL would install more packages than its agents need here.
.venv-peers-%/.ready: bench/peers/%.txt constraints.txt pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --constraint constraints.txt --editable . -r $<
	test $* != dqn || $(@D)/bin/python -m pip install --quiet --no-deps mushroom-rl==1.10.2
	@touch $@

bench-peers: .venv-peers-forests/.ready .venv-peers-dqn/.ready ## the same against other packages, in separate environments
	.venv-peers-forests/bin/python bench/peer_forests.py
	.venv-peers-dqn/bin/python bench/peer_dqn.py
	.venv-peers-dqn/bin/python bench/peer_fqi.py

clean: ## remove .venv and caches; results in runs/ stay
	rm -rf $(VENV) .venv-peers-* .pytest_cache .ruff_cache .mypy_cache .import_linter_cache site
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
