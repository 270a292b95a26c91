# `make demo` shows it, `make test` tests it. Both build .venv first.
PYTHON ?= python3
BIN := .venv/bin
# What a demo needs, and what everything else needs too.
DEMO := .venv/.demo
STAMP := .venv/.installed

.PHONY: demo reproduce test coverage properties mutation bench audit lint format clean help

help:
	@echo "make demo        the paper's Test 2 with and without the volume barrier, in out/"
	@echo "make reproduce   everything the paper shows, in out/reproduction (half an hour)"
	@echo "make test        every test, on all processors"
	@echo "make coverage    every test, and how much of each package they reach"
	@echo "make properties  the filter's promises on a million hostile ticks (an hour)"
	@echo "make mutation    which small faults in vcbf_drake/safety no test notices (hours)"
	@echo "make bench       CPU times, beside the peers that are installed"
	@echo "make audit       known vulnerabilities of what is installed, from PyPI's advisories"
	@echo "make lint        format, lint and type checks"
	@echo "make format      what of these can be mended by itself"
	@echo "make clean       removes .venv and out/"

.venv/.made:
	@echo "== a virtual environment in .venv"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	@touch $@

$(DEMO): pyproject.toml | .venv/.made
	@echo "== vcbf_drake, Drake and matplotlib from PyPI (some 250 MB)"
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(STAMP): pyproject.toml | .venv/.made
	@echo "== what tests, lint and the paper's report need, from PyPI (some 400 MB)"
	$(BIN)/python -m pip install --quiet --editable '.[test,dev]'
	@touch $(DEMO) $@

demo: $(DEMO)
	@echo "== two flights, figures and a replay: about half a minute"
	$(BIN)/vcbf-drake compare blimp-multiple-obstacles --methods dob-cbf-qp,dob-vcbf-qp
	@echo "Open out/blimp-multiple-obstacles/replay.html in a browser."

reproduce: $(STAMP)
	$(BIN)/python -m examples.paper

test: $(STAMP)
	$(BIN)/python -m pytest -n auto

coverage: $(STAMP)
	$(BIN)/python -m pytest -n auto --cov --cov-report=
	$(BIN)/python tests/coverage_table.py

properties: $(STAMP)
	$(BIN)/python -m tests.properties

mutation: $(STAMP)
	$(BIN)/python -m pip install --quiet cosmic-ray
	$(BIN)/python -m tests.mutation

bench: $(STAMP)
	$(BIN)/python -m tests.benchmarks

audit: $(STAMP)
	$(BIN)/python -m pip install --quiet pip-audit
	$(BIN)/pip-audit --local --skip-editable

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf .venv out .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis
