# `make` or `make help` lists the targets; every target sets up what it needs by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SCALE ?= quick
WORKERS ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)

.DEFAULT_GOAL := help
.PHONY: help setup figures paper searches smoke report verify test lint bench bench-peer clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(READY) ## install everything into .venv, at the exact versions of constraints.txt

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "bcrl needs Python 3.11 or newer; use make PYTHON=python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev]'
	@touch $@

figures: $(READY) ## the paper's figures from runs of your own: 3 seeds a variant, minutes
	$(BIN)/bcrl -m experiment=fig1,fig2,fig4 scale=quick workers=$(WORKERS)
	$(BIN)/bcrl-report --scale quick

paper: $(READY) ## the same at the paper's number of seeds
	$(BIN)/bcrl -m experiment=fig1,fig2,fig4 scale=paper workers=$(WORKERS)
	$(BIN)/bcrl-report --scale paper

searches: $(READY) ## the searches of appendix C.3 on seeds of their own, with summary tables
	$(BIN)/bcrl -m experiment=search_target_update,search_offset,search_nu workers=$(WORKERS)
	$(BIN)/bcrl-report --scale search

smoke: $(READY) ## every variant in seconds, then the report
	$(BIN)/bcrl -m experiment=fig1,fig2,fig4 scale=smoke workers=$(WORKERS)
	$(BIN)/bcrl-report --scale smoke

report: $(READY) ## figures, claims and one HTML page of what is in runs/; SCALE=paper
	$(BIN)/bcrl-report --scale $(SCALE)

verify: $(READY) ## whether every result in runs/ is whole, unchanged and in its place
	$(BIN)/bcrl-verify

test: $(READY) ## the tests
	$(BIN)/python -m pytest --numprocesses 2

lint: $(READY) ## style and unused code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

bench: $(READY) ## speed, as ratios against the plain way in one run
	$(BIN)/python bench/forest.py
	$(BIN)/python bench/iteration.py
	$(BIN)/python bench/growth.py
	$(BIN)/python bench/dqn.py
	$(BIN)/python bench/methods.py
	$(BIN)/python bench/checkpoints.py
	test ! -d runs/paper || $(BIN)/python bench/paper.py

bench-peer: $(READY) ## the same against MushroomRL 1.10.2, in an environment of its own
	test -x .venv-peer/bin/python || $(PYTHON) -m venv .venv-peer
	.venv-peer/bin/python -m pip install --quiet --constraint constraints.txt --editable .
	.venv-peer/bin/python -m pip install --quiet pygame==2.6.1 opencv-python-headless==5.0.0.93
	.venv-peer/bin/python -m pip install --quiet --no-deps mushroom-rl==1.10.2
	.venv-peer/bin/python bench/peer.py

clean: ## remove .venv and caches; results in runs/ stay
	rm -rf $(VENV) .venv-peer .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
