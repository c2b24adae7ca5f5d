# Everything runs in one virtual environment, VENV, made on first use. PYTHON chooses the interpreter (>= 3.11).
PYTHON ?= python3
VENV ?= .venv
TABLE ?=
MODEL ?= law
OUT ?= report
PYTEST ?= -m pytest

# Compilation is most of what the tests cost. XLA's older kernel emitter halves it and more in the same arithmetic; no
# optimisation at all pays for programs that run for milliseconds, a little for those of the slow tests. `pytest` by
# itself, `make mutations`, the notebooks and tests/test_as_compiled_for_users.py compile as users do. An XLA that does
# not know a flag stops, as that of jax 0.12 does at the first one: it is given to those that take it.
OLD_EMITTER := --xla_cpu_use_fusion_emitters=false
# asked once, when a recipe needs it: the interpreter is there by then
KNOWN = $(eval KNOWN := $(shell XLA_FLAGS=$(OLD_EMITTER) $(BIN)/python -c 'import jax; jax.devices()' 2>/dev/null && echo $(OLD_EMITTER)))$(KNOWN)
COMPILED_AT_ONCE = $(KNOWN) --xla_backend_optimization_level=0
COMPILED_SOON = $(KNOWN) --xla_backend_optimization_level=1
# Tests of the last digits, which the order of roundings decides.
SHARP := tests/test_polynomial_roots.py tests/test_verification.py

BIN := $(VENV)/bin
SETUP := $(VENV)/.installed
PIP ?=

.PHONY: help setup fit test newest oldest check thorough lint types coverage slow long docs pictures mutations bands tapping energies ranks fuzz kills bench clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -e 's/:.*##/:/' -e 's/^/  make /'

setup: $(SETUP) ## make VENV with the package and what its tests need

$(SETUP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "afm-jax needs Python >= 3.11; name one with: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP) --editable '.[dev]'
	@touch $@

fit: $(SETUP) ## fit the bundled table (or TABLE=..., MODEL=...), print the impact law, write OUT=report/
	$(BIN)/afm-jax fit $(if $(TABLE),'$(TABLE)',--example) --model $(MODEL) --out $(OUT)

test: $(SETUP) ## the tests (five minutes on two cores)
	XLA_FLAGS="$$XLA_FLAGS $(COMPILED_AT_ONCE)" $(BIN)/python $(PYTEST) -n auto --dist worksteal $(SHARP:%=--ignore %)
	XLA_FLAGS="$$XLA_FLAGS $(COMPILED_SOON)" $(BIN)/python $(PYTEST) -n auto $(SHARP)

# The Pythons that are found, those of pyenv included: the first is the oldest, the last the newest.
PYTHONS = $(shell for minor in $$(seq 11 30); do \
	for python in python3.$$minor $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.$$minor.*/bin/python3; do \
	$$python -c 'import ensurepip, sys; sys.exit(sys.version_info.releaselevel != "final")' 2>/dev/null && \
	echo $$python && break; done; done; true)
RUN ?= test
VERSIONS = $(1)/bin/python -c 'import sys, jax; print("Python", *sys.version.split()[:1], "with jax", jax.__version__)'

newest: ## make test on the newest Python and JAX found, in .venv-newest; RUN=check: all of make check there
	rm -f .venv-newest/.installed
	$(MAKE) setup VENV=.venv-newest PYTHON=$(lastword $(PYTHONS)) PIP='--upgrade --upgrade-strategy eager'
	@$(call VERSIONS,.venv-newest)
	$(MAKE) $(RUN) VENV=.venv-newest

oldest: ## make test with exactly the lower bounds of pyproject.toml, on the oldest Python found, in .venv-oldest
	@mkdir -p .venv-oldest && rm -f .venv-oldest/.installed
	$(firstword $(PYTHONS)) -m tests.lower_bounds > .venv-oldest/constraints.txt
	$(MAKE) setup VENV=.venv-oldest PYTHON=$(firstword $(PYTHONS)) PIP='--constraint .venv-oldest/constraints.txt'
	@$(call VERSIONS,.venv-oldest)
	$(MAKE) $(RUN) VENV=.venv-oldest

lint: $(SETUP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(SETUP)
	$(BIN)/pyright --pythonpath $(BIN)/python

# From Python 3.12 on lines are counted by sys.monitoring, which costs little; the tracer before it doubles the time.
TRACED := COVERAGE_CORE=$$($(BIN)/python -c 'import sys; print("sysmon" if sys.version_info >= (3, 12) else "ctrace")')

coverage: $(SETUP) ## make test and make slow with line coverage (at least 90 %)
	$(BIN)/python -m coverage erase
	$(TRACED) $(MAKE) test PYTEST='-m coverage run -m pytest'
	$(TRACED) $(MAKE) slow PYTEST='-m coverage run -m pytest'
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage report --fail-under=90

slow: $(SETUP) ## the slow tests: long iterations, references, notebooks
	XLA_FLAGS="$$XLA_FLAGS $(COMPILED_SOON)" $(BIN)/python $(PYTEST) -m $(or $(MARK),"slow and not long") -n auto --dist worksteal --ignore tests/test_mutations.py

long: ## the slow tests of more than a minute each
	$(MAKE) slow MARK=long

docs: $(SETUP) ## the site, in build/site/index.html; notebooks are run unless `make slow` did
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --config-file notebooks/mkdocs.yml

pictures: $(SETUP) ## the pictures of README and site anew, by the commands beside them
	$(BIN)/python notebooks/make_pictures.py

mutations: $(SETUP) ## mutation tests: wrong formulas, one edit each, that a named test must notice
	$(BIN)/python -m pytest -m slow tests/test_mutations.py

FUZZ ?= --flights 100000 --orbits 10000 --scenes 2000 --files 4000

fuzz: $(SETUP) ## seeded fuzzing of flights, orbits, scenes and files; FUZZ='--flights 1000000 --orbits 100000 --scenes 10000 --files 20000' for all of it
	XLA_FLAGS="$$XLA_FLAGS $(COMPILED_SOON)" $(BIN)/python -m tests.fuzz $(FUZZ)

bands: $(SETUP) ## do 95 % bands hold the laws of ten random contacts, intervals r and epsilon of twenty? (forty minutes; truths are kept in /tmp)
	$(BIN)/python -m tests.coverage_of_bands
	$(BIN)/python -m tests.coverage_of_bands --intervals

tapping: $(SETUP) ## are tapping curves of random contacts predicted and fitted as they should be? (TAPPING="--contacts 0:20")
	$(BIN)/python -m tests.tapping_accuracy $(TAPPING)

ENERGIES ?= --curves 200 --shaped 75

energies: $(SETUP) ## do the 95 % bands of the energy of a tap hold the energies of 2,700 simulated curves? (half an hour)
	$(BIN)/python -m tests.coverage_of_tapping $(ENERGIES)

ranks: $(SETUP) ## are true values anywhere in the posteriors of 1000 simulated tables equally often? (half an hour)
	$(BIN)/python -m tests.coverage_of_ranks

KILLS ?= --times 50

kills: $(SETUP) ## a sweep killed at fifty random times and resumed ends in the bytes of one that was not
	$(BIN)/python -m tests.kills $(KILLS)

check: lint types test slow docs ## all that CI runs: format, lint, types, tests, slow tests, notebooks, site

thorough: lint types coverage long mutations bands tapping energies ranks fuzz kills newest ## all of make check with line coverage, long tests, mutation tests, bands, tapping curves, energies of taps, ranks, fuzzing, kills, the newest Python and JAX

BENCH ?= $(if $(BESIDE),--beside '$(BESIDE)')

bench: $(SETUP) ## times on this machine, SciPy beside (ten minutes); writes the table of the page of benchmarks; BESIDE=DIR: another checkout, too
	$(BIN)/python -m tests.benchmarks $(BENCH)

clean: ## remove the environment, caches and reports
	rm -rf .venv .venv-newest .venv-oldest report results .pytest_cache .ruff_cache .hypothesis .coverage build dist *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
