# `make demo` and `make test` set up what they need by themselves, once; `make help` lists the rest.

# Any Python from 3.11 on: make demo PYTHON=/path/to/python3.13
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	$$python -c '$(IS_NEW_ENOUGH)' 2>/dev/null && echo $$python && break; done)
# The workstation's environment (torch, linters), and the car's (neither torch nor onnx).
VENV ?= .venv
RUNTIME_VENV ?= .venv-runtime
FUZZ_VENV ?= .venv-fuzz
MUTATION_VENV ?= .venv-mutation
FUZZ_SECONDS ?= 60
FUZZ_JOBS ?= 1
FUZZ_TARGETS ?=
MUTATION_MODULES ?=
MUTATION_JOBS ?= 1
# Many tests wait for something: three at a time keep two cores busy.
PYTEST_ARGS ?= -n 3 --dist loadfile

.DEFAULT_GOAL := help
.PHONY: help demo test test-runtime lint docs cli-reference conformance conformance-table fuzz mutation coverage bench figures systems-table view-figures view-picture faults soak load under-load recording-cost clean

help: ## list what can be made
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1	\2/p' $(MAKEFILE_LIST) | expand -t 20

demo: $(RUNTIME_VENV)/.installed-view ## see it work: recorded traffic over CAN, predicted and scored
	@$(RUNTIME_VENV)/bin/eqrt demo

test: $(VENV)/.installed test-runtime ## run all tests: without torch what ships to the car, then the rest
	$(VENV)/bin/python -m pytest $(PYTEST_ARGS) --ignore=tests/core --ignore=tests/runtime

test-runtime: $(RUNTIME_VENV)/.installed-tests ## run the tests of what ships to the car, without torch
	$(RUNTIME_VENV)/bin/python -m pytest $(PYTEST_ARGS) tests/core tests/runtime

lint: $(VENV)/.installed ## check format, style, types, and who imports whom
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

docs: $(VENV)/.installed ## build the documentation into site/, ready to be read offline
	$(VENV)/bin/mkdocs build --strict

cli-reference: $(VENV)/.installed ## write docs/cli.md from the parsers of the commands
	PYTHONPATH=tests $(VENV)/bin/python -m documentation.cli_reference --write

conformance: $(RUNTIME_VENV)/.installed ## run the shipped models in other runtimes and stacks (deploy/examples)
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python -m conformance.run

conformance-table: $(RUNTIME_VENV)/.installed ## the same, and write what was found into docs/conformance.md
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python -m conformance.run --write

fuzz: $(FUZZ_VENV)/.installed ## fuzz every parser for FUZZ_SECONDS (60); FUZZ_TARGETS="tile dbc" for some
	@PYTHONPATH=tests $(FUZZ_VENV)/bin/python -m fuzz.run --seconds $(FUZZ_SECONDS) --jobs $(FUZZ_JOBS) $(FUZZ_TARGETS)

mutation: $(MUTATION_VENV)/.installed ## change the code in every small way and see that a test notices; takes long
	@PYTHONPATH=tests $(MUTATION_VENV)/bin/python -m mutation.run --jobs $(MUTATION_JOBS) $(MUTATION_MODULES)

coverage: $(VENV)/.installed ## check that tests reach every line and branch of what `make mutation` changes
	@PYTHONPATH=tests $(VENV)/bin/python -m mutation.cover

bench: $(VENV)/.installed ## measure against the budgets, in 9 minutes; wants a quiet machine
	$(VENV)/bin/python -m pytest --benchmark-enable --benchmark-only tests/bench

figures: $(RUNTIME_VENV)/.installed ## print what eqrt does on this machine, measured; wants it quiet
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python tests/bench/figures.py

under-load: $(RUNTIME_VENV)/.installed ## measure the service beside three busy programs, with and without [realtime]; needs its rights
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python tests/bench/under_load.py

recording-cost: $(RUNTIME_VENV)/.installed ## measure the service's latency with and without --record, in turns, in 7 minutes; wants it quiet
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python tests/bench/recording_cost.py

load: $(RUNTIME_VENV)/.installed ## send 4,000 and 10,000 messages/s to a service, in 2 minutes; nothing may be lost
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python -m load.run --seconds 60

systems-table: $(VENV)/.installed ## put all systems side by side into docs/: time, error, plot; wants a quiet machine
	@PYTHONPATH=tests $(VENV)/bin/python -m bench.systems.run --write

view-figures: $(VENV)/.installed ## print what watching costs: frames of the page, latency beside browsers
	@PYTHONPATH=tests $(VENV)/bin/python tests/bench/view_figures.py

view-picture: $(VENV)/.installed ## take docs/view.png anew
	@PYTHONPATH=tests $(VENV)/bin/python tests/bench/view_picture.py

faults: $(VENV)/.installed ## throw faults at messages, machine and model, then kill the service 100 times; in 6 minutes
	FAULT_EXAMPLES=200 $(VENV)/bin/python -m pytest -q tests/faults/test_pipeline_machine.py
	@PYTHONPATH=tests $(VENV)/bin/python -m faults.campaign
	@PYTHONPATH=tests $(VENV)/bin/python -m faults.restarts

soak: $(RUNTIME_VENV)/.installed ## a simulated day and a real hour of traffic, in 2 hours
	@PYTHONPATH=tests $(RUNTIME_VENV)/bin/python -m soak.run

clean: ## remove the environments and everything else that was made here
	rm -rf .venv .venv-* build dist site .*_cache .benchmarks .hypothesis .conformance .artifacts .fuzz .mutation .coverage .systems
	rm -rf deploy/examples/build deploy/examples/javascript/node_modules
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp `.installed` in an environment is as old as the environment's last update.
IS_NEW_ENOUGH = import sys; sys.exit(sys.version_info < (3, 11))
PIP_INSTALL = -m pip install -qq --disable-pip-version-check --constraint constraints.txt

$(VENV)/.installed: pyproject.toml constraints.txt
	$(call create_environment,$(VENV),the workstation: torch and linters)
	@$(VENV)/bin/python $(PIP_INSTALL) 'pip>=25.1'
	@$(VENV)/bin/python $(PIP_INSTALL) --editable '.[export,maps,data,scale,sim,bridges,view]' --group dev
	@touch $@

$(RUNTIME_VENV)/.installed: pyproject.toml constraints.txt
	$(call create_environment,$(RUNTIME_VENV),what ships to the car)
	@$(RUNTIME_VENV)/bin/python $(PIP_INSTALL) --editable .
	@touch $@

$(RUNTIME_VENV)/.installed-view: $(RUNTIME_VENV)/.installed
	@$(RUNTIME_VENV)/bin/python $(PIP_INSTALL) --editable '.[view]'
	@touch $@

$(FUZZ_VENV)/.installed: pyproject.toml constraints.txt
	$(call create_environment,$(FUZZ_VENV),what ships to the car and a fuzzer)
	@$(FUZZ_VENV)/bin/python $(PIP_INSTALL) 'pip>=25.1'
	@$(FUZZ_VENV)/bin/python $(PIP_INSTALL) --editable . --group fuzz
	@touch $@

$(MUTATION_VENV)/.installed: pyproject.toml constraints.txt
	$(call create_environment,$(MUTATION_VENV),what ships to the car and a maker of mutants)
	@$(MUTATION_VENV)/bin/python $(PIP_INSTALL) 'pip>=25.1'
	@$(MUTATION_VENV)/bin/python $(PIP_INSTALL) --editable . --group mutation
	@$(MUTATION_VENV)/bin/python -m pip uninstall -qq --yes eqrt # the mutants are to be imported
	@touch $@

$(RUNTIME_VENV)/.installed-tests: $(RUNTIME_VENV)/.installed
	@$(RUNTIME_VENV)/bin/python $(PIP_INSTALL) 'pip>=25.1'
	@$(RUNTIME_VENV)/bin/python $(PIP_INSTALL) --group test
	@touch $@

# $(1) folder, $(2) what for. Says in one line what Python and pip would say in twenty.
define create_environment
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11 or newer found (tried python3 and python3.11 to python3.13); install one, or name it: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c '$(IS_NEW_ENOUGH)' 2>/dev/null || { echo "make: $(PYTHON) is not Python 3.11 or newer ($$($(PYTHON) --version 2>&1 | tail -n 1)); name one that is: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "make: $(PYTHON) cannot make virtual environments; on Debian and Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	@echo "setting up $(1) ($(2)) with $$($(PYTHON) --version), once"
	@test -x $(1)/bin/python || $(PYTHON) -m venv $(1)
endef
