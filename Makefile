# One word per task; `make` alone lists them. Each sets up what it needs the first time and is quick after that.
# Another Python: make PYTHON=python3.12 test. Another environment: make VENV=/tmp/venv test.

SHELL := /bin/bash
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
WORKERS ?= 2
READY := $(VENV)/.ready
VALIDATOR := tests/glb_validator/node_modules/.ready
COMPILER := frontend/node_modules/.ready

.DEFAULT_GOAL := help
.PHONY: help setup demo test check bench docs verify reference pictures lock clean

help: ## this list
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/' | expand -t 18

$(READY): constraints/dev.txt constraints/meshopt.txt pyproject.toml tools/make_venv.sh
	@tools/make_venv.sh "$(PYTHON)" "$(VENV)"
	@touch $@

$(VALIDATOR): tests/glb_validator/package-lock.json tools/npm_packages.sh
	@tools/npm_packages.sh tests/glb_validator "the tests of surface.glb against Khronos' validator"

$(COMPILER): frontend/package-lock.json tools/npm_packages.sh
	@tools/npm_packages.sh frontend "the test of the page's types by a TypeScript compiler"

setup: $(READY) $(VALIDATOR) $(COMPILER) ## the environment alone

demo: $(READY) ## scan a wet specimen on the simulated instrument and show the result
	$(BIN)/fringescope demo --out build/demo --force

test: $(READY) $(VALIDATOR) $(COMPILER) ## the tests
	$(BIN)/pytest -n $(WORKERS) --dist loadfile

check: $(READY) ## lint and types; what CI runs before the tests
	$(BIN)/ruff check .
	$(BIN)/mypy

PEERS := build/peers/.ready

$(PEERS): benchmarks/peers.txt
	@$(PYTHON) -m venv --clear build/peers
	@build/peers/bin/pip install --quiet --disable-pip-version-check -r benchmarks/peers.txt
	@touch $@

bench: $(READY) $(PEERS) ## time a scan against a plain copy of its memory and against other decoders (in an environment of their own)
	$(BIN)/fringescope bench --whole --peer-python build/peers/bin/python

docs: $(READY) ## the documentation as a static site in build/docs
	$(BIN)/python tools/make_reference.py
	$(BIN)/sphinx-build -W --keep-going -q -b html docs build/docs
	@echo "build/docs/index.html"

verify: $(READY) $(VALIDATOR) $(COMPILER) ## the long statistical tests; goes on where it stopped, writes docs/evidence/
	$(BIN)/python tools/verify.py

reference: $(READY) ## write docs/reference/ anew from the code
	$(BIN)/python tools/make_reference.py

pictures: $(READY) ## draw the pictures of README and docs anew from the digital twin
	$(BIN)/python tools/make_pictures.py

lock: ## resolve constraints/ anew (needs uv from the package registry)
	tools/lock.sh "$(PYTHON)"

clean: ## remove what the targets made, the environment too
	rm -rf build tests/glb_validator/node_modules frontend/node_modules "$(VENV)" .mypy_cache .ruff_cache .pytest_cache
