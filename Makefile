# Two commands do everything: `make demo` and `make test`. Both build .venv first.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: demo reproduce properties test coverage mutation audit lint format bench clean help

help:
	@echo "make demo       the paper's Test 2 with and without the volume barrier, in out/"
	@echo "make reproduce  everything the paper shows, in out/reproduction"
	@echo "make properties the filter's promises on a million hostile ticks"
	@echo "make test       every test"
	@echo "make coverage   every test, and how much of each package they reach"
	@echo "make mutation   which small faults in vcbf_drake/safety no test notices"
	@echo "make audit      known vulnerabilities of what is installed, from PyPI's advisories"
	@echo "make lint       format, lint and type checks"
	@echo "make bench      benchmarks (CPU time)"
	@echo "make clean      removes .venv and out/"

$(STAMP): pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test,dev]'
	@touch $@

demo: $(STAMP)
	$(BIN)/vcbf-drake compare blimp-multiple-obstacles --methods dob-cbf-qp,dob-vcbf-qp

reproduce: $(STAMP)
	$(BIN)/python -m examples.paper

properties: $(STAMP)
	$(BIN)/python -m tests.properties

test: $(STAMP)
	$(BIN)/python -m pytest

coverage: $(STAMP)
	$(BIN)/python -m pytest --cov --cov-report=
	$(BIN)/python tests/coverage_table.py

mutation: $(STAMP)
	$(BIN)/python -m tests.mutation vcbf_drake/safety

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

bench: $(STAMP)
	$(BIN)/python -m tests.benchmarks

clean:
	rm -rf .venv out .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis
