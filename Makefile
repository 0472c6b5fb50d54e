# Everything runs from a clean clone: the first target that needs it makes .venv with the pinned versions.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# --no-compile: byte code is made of what is imported, when it is; compiling all of torch takes half a minute
PIP    := $(BIN)/pip --disable-pip-version-check install --quiet --no-compile -c constraints.txt
WORKERS ?= 2
MORE    ?=  # options of pytest: make test MORE=--lf

.PHONY: demo pictures test fast-tests test-all test-floors bench schemas docs stability lint style types format clean
.DELETE_ON_ERROR:

NEEDED := pyproject.toml constraints.txt

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# one installation for each, not one upon the other
$(VENV)/.test: $(NEEDED) | $(BIN)/python
	rm -rf otsync.egg-info  # a stale one hides new entry points
	$(PIP) -e '.[recon,test]'
	touch $@

$(VENV)/.demo: $(NEEDED) | $(BIN)/python
	rm -rf otsync.egg-info
	$(PIP) -e '.[recon,video]'
	touch $@

demo: $(VENV)/.demo  ## films a small moving world, and does the whole job on the videos; writes demo/
	$(BIN)/otsync --quiet demo --out demo

test: $(VENV)/.test style  ## under ten minutes on two quiet cores; what is left out: tests/slow.py
	@$(MAKE) --no-print-directory --jobs=2 types fast-tests

fast-tests: $(VENV)/.test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "not slow" --durations=20 --durations-min=4 $(MORE)

test-all: $(VENV)/.test lint  ## every test, the slow ones too
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile $(MORE)

test-floors:  ## fast tests of the core with the lowest versions that pyproject.toml allows, in an environment of its own
	PYTHON=$(PYTHON) WORKERS=$(WORKERS) .ci/floors

bench: $(VENV)/.test  ## what is timed; writes bench/out/
	$(BIN)/otsync bench all --out bench/out

lint: style types

style: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.test
	$(BIN)/mypy

$(VENV)/.docs: $(NEEDED) | $(BIN)/python
	rm -rf otsync.egg-info
	$(PIP) -e '.[docs,video]'
	touch $@

pictures: $(VENV)/.test  ## docs/demo.webp and docs/report.webp, of the demo's pages; needs Chromium
	$(BIN)/otsync --quiet demo --out demo
	$(BIN)/python -m tests.docs.pictures demo docs

schemas: $(VENV)/.test  ## docs/schemas/, from what the readers ask for
	$(BIN)/python -m otsync.io.schemas docs/schemas
	$(BIN)/python -m recon.result.layout docs/schemas

docs: $(VENV)/.docs  ## the pages of docs/ as HTML in site/; fails on warnings, and on pages that load from a network
	$(BIN)/python -m tests.docs.gallery docs $(wildcard demo/result)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/python -m tests.docs.offline site
	@echo "wrote site/; look at it: $(BIN)/python -m http.server --directory site"

stability: $(VENV)/.test  ## docs/stability.md, from the catalogue of hard cases
	$(BIN)/python -m otsync.bench.hard_cases.page

format: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info demo bench/out site
