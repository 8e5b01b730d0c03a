# make demo      solves Pendulum from a few real steps; make demo ARGS="--seed 1" passes options on
# make test      everything that guards the project
# make help      the rest

PYTHON ?= python3
# One more than cores: tests wait for processes a quarter of their time.
WORKERS ?= 3
ARGS ?=

BIN := .venv/bin
# What is not imported needs no bytecode: compiling every module takes longer than unpacking it.
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile --constraint constraints.txt
PINS := pyproject.toml constraints.txt
# It is written when a module is first imported, also where the environment says not to (images of Python do): tests and
# the demo start many processes, and each that imports torch would spend five seconds on compiling.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: demo install test lab-test release audit test-all docs docs-serve format-check lint types imports unit chaos bench bench-memory acquisition audit-power compare format postgresql haproxy chromium languages screenshots picture clean help

demo: .venv/demo  ## Solve Pendulum with server, sampler and trainer on this machine (ARGS="--seed 1")
	@exec $(BIN)/surrogym demo pendulum $(ARGS)

install: .venv/all  ## Surrogym into .venv, with MuJoCo, pictures and exports
	@echo "next: . .venv/bin/activate"

test: format-check lint  ## Everything that guards the project
	@$(MAKE) --no-print-directory --jobs 2 unit types imports audit

format-check: .venv/dev
	$(BIN)/ruff format --check

lint: .venv/dev  ## Look for mistakes
	$(BIN)/ruff check

types: .venv/dev  ## Check the types
	$(BIN)/mypy

imports: .venv/dev  ## Check which room imports which
	$(BIN)/lint-imports

unit: .venv/dev postgresql chromium languages  ## The tests alone (ARGS="-k pendulum")
	$(BIN)/pytest --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

lab-test: .venv/dev  ## The tests of the lab: studies, peers, unseen tasks (ARGS="-k pilco")
	$(BIN)/pytest lab/tests --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-all: test lab-test .venv-extras .venv-adapters  ## make test, every command of the docs, and trainers and trackers with packages of their own
	$(BIN)/pytest -m long tests lab/tests --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder
	DOCS=full $(BIN)/pytest -m "" --durations 0 tests/docs tests/examples
	.venv-adapters/bin/python -m pytest -m "" tests/original/test_adapters.py tests/original/test_describing.py

docs: .venv/dev  ## Build the site into build/docs; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

docs-serve: .venv/dev  ## Show the site while its pages are written
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

release: .venv/dev  ## Build wheel and source distribution into dist/ and check that each works alone; nothing is published
	rm -rf dist
	$(BIN)/python -m hatchling build --target sdist --target wheel
	$(BIN)/python tests/release.py dist

audit: .venv/dev  ## Ask for known holes of the pinned packages, where that can be asked
	@$(BIN)/python tests/audit.py

chaos: .venv/dev postgresql haproxy  ## Faults, attacks and clusters in full length; make test has a short form (ARGS="-k killed")
	CHAOS=full $(BIN)/pytest -m "" --durations 0 tests/chaos tests/security tests/server/features/ray $(ARGS)

bench: .venv/dev  ## What steps, predictions and trainings cost here, beside echoes, libraries and other systems (ARGS="--quick")
	$(BIN)/python lab/benchmarks/bench.py $(ARGS)

bench-memory: .venv/dev  ## Resident memory of a server with 64 sessions of 256 lanes, 10 minutes (ARGS="--minutes 1")
	$(BIN)/python lab/benchmarks/bench_memory.py $(ARGS)

acquisition: .venv/dev  ## Adaptive queries beside a Latin hypercube, by model error (ARGS="--tasks pendulum --seeds 10")
	$(BIN)/python lab/benchmarks/acquisition.py $(ARGS)

audit-power: .venv/dev  ## Do audits find 100 wrong models, and leave 100 right ones alone? (ARGS="--right 2 --wrong 1")
	$(BIN)/python lab/benchmarks/audit_power.py $(ARGS)

compare: .venv/dev  ## Behaviour and speed of two commits, side by side (ARGS="BEFORE AFTER")
	$(BIN)/python lab/benchmarks/compare_commits.py $(ARGS)

format: .venv/dev  ## Put the code into shape
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

postgresql:
	@if ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1; then \
	    :; \
	elif [ -n "$$CI" ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq postgresql >/dev/null; \
	else \
	    echo "PostgreSQL is not on this machine, so its tests are skipped. To run them: apt-get install postgresql"; \
	fi

haproxy:
	@if PATH="$$PATH:/usr/sbin" command -v haproxy >/dev/null; then \
	    :; \
	elif [ -n "$$CI" ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq haproxy >/dev/null; \
	else \
	    echo "HAProxy is not on this machine, so the tests of kills under load are skipped. To run them: apt-get install haproxy"; \
	fi

chromium:
	@if command -v chromium chromium-browser google-chrome >/dev/null; then \
	    :; \
	elif [ -n "$$CI" ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium >/dev/null; \
	else \
	    echo "Chromium is not on this machine, so the tests of the page are skipped. To run them: apt-get install chromium"; \
	fi

languages:
	@if command -v cc >/dev/null && command -v node >/dev/null; then \
	    :; \
	elif [ -n "$$CI" ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq gcc libc6-dev nodejs >/dev/null; \
	else \
	    echo "cc or node is not on this machine, so the tests of their examples are skipped. To run them: apt-get install gcc libc6-dev nodejs"; \
	fi

screenshots: .venv/dev chromium  ## Pictures of the page for the docs, from a live Pendulum
	$(BIN)/python tests/dashboard/screenshots.py

picture: .venv/dev  ## The moving picture of the README, from a Pendulum that is learned anew
	$(BIN)/python tests/docs/moving_picture.py

clean:  ## Remove the virtual environment, caches and builds; run folders stay
	rm -rf .venv .venv-extras .venv-adapters build dist .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find client server shared lab tests -name __pycache__ -type d -prune -exec rm -rf {} +

help:  ## This list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "Python 3.11 or newer is needed: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/demo: $(PINS) | .venv/bin/python
	@echo "installing into .venv; this takes a minute or two the first time"
	@$(PIP) --editable ".[server,train]"
	@touch $@

.venv/all: $(PINS) | .venv/bin/python
	@echo "installing into .venv; this takes some minutes the first time"
	@$(PIP) --editable ".[all]"
	@touch $@ .venv/demo

.venv-extras: pyproject.toml constraints-extras.txt | .venv/bin/python
	@echo "installing RLlib, TorchRL, tianshou, sb3-contrib, MLflow and Weights & Biases into .venv-extras"
	@$(PYTHON) -m venv .venv-extras
	@.venv-extras/bin/python -m pip install -qq --disable-pip-version-check --constraint constraints-extras.txt \
	    --editable ".[train,torchrl,rllib,contrib,trackers]" tianshou
	@touch $@

.venv-adapters: pyproject.toml constraints-adapters.txt | .venv/bin/python
	@echo "installing dm_control, Gymnasium-Robotics and pc-gym into .venv-adapters"
	@$(PYTHON) -m venv .venv-adapters
	@.venv-adapters/bin/python -m pip install -qq --disable-pip-version-check --no-compile \
	    --constraint constraints-adapters.txt --editable ".[server,train,adapters]" pytest pytest-timeout hypothesis
	@touch $@

.venv/dev: $(PINS) | .venv/bin/python
	@echo "installing into .venv; this takes some minutes the first time"
	@$(PIP) --editable ".[dev]"
	@touch $@ .venv/all .venv/demo
