# `make demo` shows it, `make test` tests it. Both build .venv first.
PYTHON ?= python3
BIN := .venv/bin
# What a demo needs, and what everything else needs too.
DEMO := .venv/.demo
STAMP := .venv/.installed
# What `make mutation` puts faults into, and who should notice.
MODULE ?= vcbf_drake/safety/volume.py
TESTS ?= tests/safety

.PHONY: demo reproduce test coverage properties mutation results images bench audit lint format clean help

help:
	@echo "make demo        the paper's Test 2 with and without the volume barrier, in out/"
	@echo "make reproduce   everything the paper shows, in out/reproduction (half an hour)"
	@echo "make test        every test, on all processors"
	@echo "make coverage    every test, and how much of each package they reach"
	@echo "make properties  the filter's promises on a million hostile ticks (quarter of an hour)"
	@echo "make mutation    MODULE=FILE TESTS=DIR: small faults that no test notices (hours)"
	@echo "make results     the pages of docs/results made anew (hours)"
	@echo "make images      the pictures of docs/images made anew (some minutes, chromium)"
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
	$(BIN)/python -m pytest -n auto --dist worksteal

coverage: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist worksteal --cov --cov-report=
	$(BIN)/python tests/coverage_table.py

properties: $(STAMP)
	$(BIN)/python -m tests.properties

# Files are changed in place, so in a copy; a run that was stopped goes on.
mutation: $(STAMP)
	$(BIN)/python -m pip install --quiet cosmic-ray
	mkdir -p out/mutation
	test -f out/mutation/session.sqlite || git archive HEAD | tar -x -C out/mutation
	cd out/mutation && sed 's|MODULE|$(MODULE)|; s|TESTS|$(TESTS)|' tests/mutation.toml > session.toml
	cd out/mutation && export PATH=$(CURDIR)/$(BIN):$$PATH && \
		(test -f session.sqlite || cosmic-ray init session.toml session.sqlite) && \
		cosmic-ray exec session.toml session.sqlite && \
		cr-report session.sqlite --surviving-only --show-diff

# The pages of docs/results that are made whole: the others have words of their own.
results: $(STAMP)
	$(BIN)/python -m tests.properties && cp out/properties/properties.md docs/results/
	$(BIN)/vcbf-drake faults blimp-multiple-obstacles car-avoidance --trials 50 \
		--out out/reliability && cp out/reliability/faults.md docs/results/reliability.md
	$(BIN)/python -m examples.paper.rates > out/between_ticks.md
	cp out/between_ticks.md docs/results/
	$(BIN)/python -m examples.paper && cp out/reproduction/reproduction.md docs/results/

images: $(STAMP)
	$(BIN)/python -m docs.make_images

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
