# Every target sets up what is missing by itself; nothing is written outside this folder but
# the cache of compiled forms.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

BIN := .venv/bin
RANKS ?= 2
# Processes that share the tests in serial.
JOBS ?= auto
# Seconds after which a run of the test-suite is stopped.
TEST_TIMEOUT ?= 900
DEMO_TIMEOUT ?= 600
# Further arguments for pytest, e.g. make test ARGS="-k rotation".
ARGS ?=

# One thread a process: the ranks share the cores, and OpenBLAS gains nothing on small blocks.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MPLCONFIGDIR ?= $(CURDIR)/.cache/matplotlib

.PHONY: help setup demo test lint docs clean test-debian

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 22

setup: ## install what is missing into .venv
	@tools/setup.sh

demo: setup ## throw a bear, by ten methods: a table, and a picture in results/thrown-bear
	@timeout -k 10 $(DEMO_TIMEOUT) $(BIN)/mixed-fem run thrown-bear

test: setup ## run the test-suite in serial, then on RANKS=2 ranks
	@echo "== tests, serial"
	@timeout -s INT -k 20 $(TEST_TIMEOUT) $(BIN)/python -m pytest \
	  -n $(JOBS) --maxprocesses 8 --dist loadfile $(ARGS)
	@echo "== tests, $(RANKS) ranks" # Open MPI gives each rank a terminal, hence PY_COLORS
	@test -t 1 || export PY_COLORS=0; \
	timeout -s INT -k 20 $(TEST_TIMEOUT) $(BIN)/mpiexec -n $(RANKS) $(BIN)/python -m pytest $(ARGS)

lint: setup ## check style, format and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

docs: setup ## build the site in build/docs: pages, demos run, reference; and check it in a browser
	@$(BIN)/python -c 'import furo, jupytext, myst_nb' 2>/dev/null || \
	  $(BIN)/python -m pip install -q --disable-pip-version-check -e '.[docs]'
	@mkdir -p build; $(BIN)/mixed-fem compare --json >build/compare.json 2>build/compare.log || \
	  { tail -n 20 build/compare.log; exit 1; }
	@$(BIN)/sphinx-build -W --keep-going -q -b html docs build/docs
	@$(BIN)/python -m pytest -q tests/test_docs.py
	@echo "docs: open build/docs/index.html"

test-debian: ## run make test in a chroot of Debian unstable, with its own DOLFINx (root only)
	@tools/test_debian.sh

clean: ## remove .venv, caches and build files; results/ stays
	@rm -rf --one-file-system .venv .python .cache build dist *.egg-info .hypothesis .mypy_cache \
	  .pytest_cache .ruff_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
