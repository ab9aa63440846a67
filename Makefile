# Every target does its own set-up in ./.venv and touches nothing else on the machine.
# Needed beforehand: make, a Python of at least 3.11 with its venv module, and a package index.

VENV := .venv
PY := $(VENV)/bin/python
LOCK := requirements-dev.lock
WORKERS ?= 2
PART ?= 1/1

# The environment is made again only when what it depends on changes: the lock, the project file, the
# interpreter asked for, or the place (an editable install remembers its folder).
KEY := $(shell { pwd; echo "$(PYTHON)"; cat pyproject.toml $(LOCK); } | cksum | tr -d ' ')
READY := $(VENV)/.ready-$(KEY)

# No question to the network about newer releases of the type checker.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test slow test-times lint types thorough bench format docs installed lock clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /  make \1@/p' Makefile | awk -F@ '{ printf "%-17s %s\n", $$1, $$2 }'

setup: $(READY) ## the development environment in ./.venv

$(READY): pyproject.toml $(LOCK)
	@set -e; python=''; \
	for candidate in $(or $(PYTHON),python3.11 python3.12 python3.13 python3.14 python3 python); do \
	    if $$candidate -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	        python=$$candidate; break; \
	    fi; \
	done; \
	if [ -z "$$python" ]; then \
	    echo 'dvax needs Python 3.11 or newer, and $(or $(PYTHON),this PATH) has none;' \
	        'say which with make PYTHON=/path/to/python3.11' >&2; \
	    exit 1; \
	fi; \
	echo "Setting up $(VENV) with $$($$python --version) (once; a later run starts at once)"; \
	rm -rf $(VENV); \
	$$python -m venv $(VENV) || { \
	    echo 'python -m venv failed; on Debian the module is in the package python3-venv' >&2; exit 1; }
	@# The lock is complete, so nothing is resolved, and of its thousands of modules only those that
	@# a run imports are compiled: either in full would double the time. They are compiled here even
	@# where the environment tells Python to write no bytecode, or every start would take seconds.
	@$(PY) -m pip install --quiet --no-deps --no-compile --requirement $(LOCK)
	@$(PY) -m pip install --quiet --no-deps --no-build-isolation --editable .
	@env -u PYTHONDONTWRITEBYTECODE $(PY) -c 'import dvax.app.cli, dvax.app.runs.driver, dvax.app.plots.report'
	@touch $@

demo: $(READY) ## solve the rough contact strip; results and report in ./demo-run
	@$(VENV)/bin/dvax demo -o demo-run --force
	@echo "The report: $(CURDIR)/demo-run/report.html"

# Tests start many processes: without bytecode each compiles what it imports.
test: lint types ## lint, formatting, types and tests (under 10 minutes on two cores)
	env -u PYTHONDONTWRITEBYTECODE $(PY) -m pytest -n $(WORKERS) --dist worksteal --durations=15
	@echo 'make test: lint, formatting, types and every test not marked slow or thorough have passed'

slow: $(READY) ## the tests that take more than about two seconds each
	env -u PYTHONDONTWRITEBYTECODE $(PY) -m pytest -n $(WORKERS) --dist worksteal \
	    -m "slow and not thorough" --durations=15

test-times: $(READY) ## the tests of make test, with the processor time of each test, file and folder
	env -u PYTHONDONTWRITEBYTECODE $(PY) -m pytest -n $(WORKERS) --dist worksteal -p tests.processor_time

lint: $(READY) ## ruff: rules and formatting
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

types: $(READY) ## pyright
	$(PY) -m pyright --project pyproject.toml --pythonpath $(PY)

thorough: $(READY) ## the long checks, which take hours; PART=2/8 takes every eighth, from the second on
	HYPOTHESIS_PROFILE=thorough $(PY) -m pytest -n $(WORKERS) --dist worksteal -m thorough --durations=15 \
	    --part $(PART)
	$(PY) -m benchmarks --full --part $(PART)
	@echo 'make thorough: tests marked thorough have passed, and full benchmarks have run (part $(PART))'

bench: $(READY) ## dvax against the peers found here: ratios, medians of repeated runs
	$(PY) -m benchmarks

format: $(READY) ## rewrite the sources in the common format
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: $(READY) ## the documentation as a site in ./site, with all examples of the gallery
	$(PY) -m pip install --quiet --no-build-isolation --editable '.[docs]'
	$(PY) -m sphinx --builder html --nitpicky --fail-on-warning --keep-going --quiet \
	    --doctree-dir build/doctrees docs site
	$(PY) -m docs.extensions.check_site site

installed: $(READY) ## wheel and sdist by name from a local index, on each Python 3.11 to 3.14 of the PATH
	$(PY) -m pytest -m thorough -rs tests/test_installation.py

lock: ## pin the newest releases that fit pyproject.toml (needs uv)
	uv pip compile pyproject.toml --extra app --extra dev --universal --python-version 3.11 \
	    --upgrade --no-emit-index-url --no-emit-find-links \
	    --custom-compile-command 'make lock' --output-file $(LOCK)

clean: ## everything the other targets have written
	rm -rf $(VENV) .cache .hypothesis .pytest_cache .ruff_cache build dist site demo-run \
	    docs/gallery docs/generated docs/reference/api
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true
