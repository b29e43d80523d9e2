# Every target creates .venv by itself: Python >= 3.11 and make are all that is needed.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
DEMO_STAMP := .venv/.installed-demo

# compiled sources are kept: the tests start many processes, which would compile them again each time
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-fast lint bench mutants coverage docs release-check clean

define environment
@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
  { echo "rigwake needs Python 3.11 or newer, found $$($(PYTHON) --version). Remedy: make PYTHON=python3.12"; exit 1; }
test -x $(BIN)/python || $(PYTHON) -m venv .venv
endef

$(STAMP): pyproject.toml constraints.txt
	$(environment)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $(STAMP) $(DEMO_STAMP)

# what only developers need takes longer to install than the demo to run; most of what is installed is never imported,
# so that Python compiles what it needs
$(DEMO_STAMP): pyproject.toml constraints.txt
	$(environment)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-compile -e '.[sim]'
	@touch $(DEMO_STAMP)

demo: $(DEMO_STAMP)
	$(BIN)/rigwake demo -o demo

test-fast: $(STAMP)
	$(BIN)/python -m pytest -n 2 -m "not slow"

test: test-fast
	$(BIN)/python -m pytest -n 2 -m slow

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# every benchmark: its figures as JSON, and the pages of docs/measurements from these
bench: $(STAMP)
	$(BIN)/python benchmarks/record.py --all

mutants: $(STAMP)
	$(BIN)/python tests/run_mutants.py

# fast suite over the main job; the table by package comes last
coverage: $(STAMP)
	rm -rf build/coverage
	$(BIN)/coverage run -m pytest -n 2 -m "not slow"
	$(BIN)/coverage combine --quiet
	$(BIN)/python tests/coverage_table.py

docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/mkdocs build --strict --site-dir build/site

release-check: $(STAMP)
	rm -rf build/release && mkdir -p build/release
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt build twine
	$(BIN)/python -m build --outdir build/release .
	$(BIN)/twine check --strict build/release/*
	$(PYTHON) -m venv build/release/env
	build/release/env/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt build/release/*.whl
	cd build/release && env/bin/rigwake --version && env/bin/rigwake simulate --show > /dev/null

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis demo build dist
