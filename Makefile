# make report   the sample flight, from logs to report.html
# make test     ruff, mypy, import-linter, pytest
# Both make .venv and find (or install) an LLVM for Dr.Jit first.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
READY_DEV := .venv/.ready-dev
READY_DOCS := .venv/.ready-docs
LLVM := .venv/.llvm
REPORT := reports/sample

# a PYTHONPATH from another project must not reach into our environment
unexport PYTHONPATH PYTHONHOME PIP_USER
# without stored bytecode, every worker and every child process of a test would compile the package again
unexport PYTHONDONTWRITEBYTECODE
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup report test bench bench-all bench-check docs learned clean
.DEFAULT_GOAL := help

help:
	@echo "make report   replay the sample flight and write $(REPORT)/report.html"
	@echo "make test     ruff, mypy, import-linter, pytest"
	@echo "make setup    only the environment .venv with the developers' tools, and an LLVM for Dr.Jit"
	@echo "make docs     the documentation as pages, build/site/index.html"
	@echo "make bench    speed against error on this machine"
	@echo "make bench-all  every benchmark with its peers in one run; makes docs/performance.md"
	@echo "make bench-check  every benchmark at its smallest size, to see that it ends without an error"
	@echo "make clean    remove .venv, caches and $(REPORT)/"

setup: $(READY_DEV) $(LLVM)

# commands need only the package; tests also need the developers' tools
$(READY): pyproject.toml requirements/run.txt tools/setup_venv
	@PYTHON="$(PYTHON)" tools/setup_venv .venv
	@touch $@

$(READY_DEV): $(READY) requirements/dev.txt
	@PYTHON="$(PYTHON)" tools/setup_venv .venv dev
	@touch $@

$(LLVM): $(READY) tools/setup_llvm.py aerpaw_cmp/propagation/llvm.py
	@$(BIN)/python tools/setup_llvm.py
	@touch $@

report: $(READY) $(LLVM)
	$(BIN)/aerpaw-cmp report sample_logs/flight.yaml -o $(REPORT) --figures png --force
	@echo "The report: $(CURDIR)/$(REPORT)/report.html"

# the files are in the order of tests/conftest.py: the slowest first
WORKERS := -q -n auto --dist loadfile --no-loadscope-reorder

# mypy uses one core, so it runs in parallel to pytest; its output comes after, then the skipped tests with reasons
test: setup
	@command -v chromedriver >/dev/null || $(BIN)/python tools/setup_browser.py
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	@said=$$(mktemp); $(BIN)/mypy >"$$said" 2>&1 & types=$$!; \
	echo "$(BIN)/python -m pytest $(WORKERS)"; \
	$(BIN)/python -m pytest $(WORKERS); tested=$$?; \
	echo "$(BIN)/mypy"; wait $$types; typed=$$?; cat "$$said"; rm -f "$$said"; \
	cat .pytest_cache/d/skipped/said; rm -f .pytest_cache/d/skipped/said; \
	[ $$tested -eq 0 ] && [ $$typed -eq 0 ]

$(READY_DOCS): $(READY) requirements/docs.txt
	@PYTHON="$(PYTHON)" tools/setup_venv .venv docs
	@touch $@

# strict: a dead link or anchor, a page without a place in the menu, a failing script of the gallery end the build; --quiet
# would also hide warnings from --strict
docs: $(READY_DOCS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "The documentation: $(CURDIR)/build/site/index.html"

bench: $(READY_DEV) $(LLVM)
	$(BIN)/aerpaw-cmp bench

bench-all: $(READY_DEV) $(LLVM)
	$(BIN)/python benchmarks/performance.py --measure

# every benchmark at its smallest size, to see that it ends without an error
bench-check: $(READY_DEV) $(LLVM)
	$(BIN)/python benchmarks/all.py --check

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache build dist $(REPORT)
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# learn the models of the packaged Lake Wheeler site again from the real logs in FIELD
learned: $(READY_DEV)
	@mkdir -p reports/learned
	for name in joint afar nr_rank; do \
	  $(BIN)/aerpaw-cmp calibrate tests/field/learned/$$name.yaml --into-site lake_wheeler --logs-root $(FIELD) \
	    -o reports/learned/$$name.yaml || exit $$?; \
	done
